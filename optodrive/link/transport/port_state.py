"""How a serial port stands, as far as the operating system tells: there, gone, forbidden, held by somebody."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

ROOT = Path("/")
SERIAL_NAMES = ("ttyACM*", "ttyUSB*")
Fate = Literal["no file", "there", "gone", "denied", "held"]


@dataclass(frozen=True)
class Holder:
    """A process that has the port open."""

    pid: int
    command: str

    def __str__(self) -> str:
        return f"{self.command}, process {self.pid}"


@dataclass(frozen=True)
class PortState:
    """fate: "no file" for a transport that is none; holders: other processes; others: serial ports there are."""

    fate: Fate
    holders: tuple[Holder, ...] = ()
    others: tuple[str, ...] = ()


def under(root: Path, path: str | Path) -> Path:
    """An absolute path within a folder that stands for /."""
    return root / str(path).lstrip("/")


def device_name(port: str, root: Path = ROOT) -> str:
    """The device a port's name leads to, links followed: /dev/ttyACM0."""
    return "/" + str(under(root, port).resolve().relative_to(root.resolve()))


def serial_ports(root: Path = ROOT) -> tuple[str, ...]:
    """Serial ports of USB devices that are there."""
    found = [path.name for pattern in SERIAL_NAMES for path in under(root, "/dev").glob(pattern)]
    return tuple(f"/dev/{name}" for name in sorted(found))


def holders(port: str, root: Path = ROOT) -> tuple[Holder, ...]:
    """Other processes that have the port open, as far as /proc lets us see."""
    names = {port, device_name(port, root)}
    pids = {
        int(process.name)
        for process in under(root, "/proc").glob("[0-9]*")
        if int(process.name) != os.getpid() and names & _open_files(process)
    }
    return tuple(Holder(pid, command(pid, root)) for pid in sorted(pids))


def _open_files(process: Path) -> set[str]:
    found = set()
    try:
        for link in (process / "fd").iterdir():
            found.add(str(link.readlink()))
    except OSError:
        pass  # another user's, or it has just ended
    return found


def command(pid: int, root: Path = ROOT) -> str:
    """A process' name."""
    try:
        return under(root, f"/proc/{pid}/comm").read_text(errors="replace").strip()
    except OSError:
        return "a process"


def port_state(port: str, root: Path = ROOT) -> PortState:
    """How a port stands now; opens nothing."""
    if not port.startswith("/"):
        return PortState("no file")
    path = under(root, port)
    try:
        there = path.exists()
    except PermissionError:
        return PortState("denied")
    if not there:
        return PortState("gone", others=serial_ports(root))
    if not os.access(path, os.R_OK | os.W_OK, effective_ids=True):
        return PortState("denied")
    held_by = holders(port, root)
    return PortState("held" if held_by else "there", held_by)
