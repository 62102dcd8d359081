"""How a serial port stands, as far as the operating system tells: there, gone, forbidden, held by somebody."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

ROOT = Path("/")
SERIAL_NAMES = ("ttyACM*", "ttyUSB*")
PortStatus = Literal["no file", "there", "gone", "denied", "held"]


@dataclass(frozen=True)
class PortHolder:
    """A process that has the port open."""

    pid: int
    command: str

    def __str__(self) -> str:
        return f"{self.command}, process {self.pid}"


@dataclass(frozen=True)
class PortState:
    """fate: "no file" for a transport that is none; holders: other processes; others: serial ports there are."""

    status: PortStatus
    holders: tuple[PortHolder, ...] = ()
    other_ports: tuple[str, ...] = ()


def join_root(root: Path, path: str | Path) -> Path:
    """An absolute path within a folder that stands for /."""
    return root / str(path).lstrip("/")


def resolve_device(port: str, root: Path = ROOT) -> str:
    """The device a port's name leads to, links followed: /dev/ttyACM0."""
    return "/" + str(join_root(root, port).resolve().relative_to(root.resolve()))


def list_serial_ports(root: Path = ROOT) -> tuple[str, ...]:
    """Serial ports of USB devices that are there."""
    found = [path.name for pattern in SERIAL_NAMES for path in join_root(root, "/dev").glob(pattern)]
    return tuple(f"/dev/{name}" for name in sorted(found))


def find_holders(port: str, root: Path = ROOT) -> tuple[PortHolder, ...]:
    """Other processes that have the port open, as far as /proc lets us see."""
    names = {port, resolve_device(port, root)}
    pids = {
        int(process.name)
        for process in join_root(root, "/proc").glob("[0-9]*")
        if int(process.name) != os.getpid() and names & _list_open_files(process)
    }
    return tuple(PortHolder(pid, read_command_name(pid, root)) for pid in sorted(pids))


def _list_open_files(process: Path) -> set[str]:
    found = set()
    try:
        for link in (process / "fd").iterdir():
            found.add(str(link.readlink()))
    except OSError:
        pass  # another user's, or it has just ended
    return found


def read_command_name(pid: int, root: Path = ROOT) -> str:
    """A process' name."""
    try:
        return join_root(root, f"/proc/{pid}/comm").read_text(errors="replace").strip()
    except OSError:
        return "a process"


def read_port_state(port: str, root: Path = ROOT) -> PortState:
    """How a port stands now; opens nothing."""
    if not port.startswith("/"):
        return PortState("no file")
    path = join_root(root, port)
    try:
        exists = path.exists()
    except PermissionError:
        return PortState("denied")
    if not exists:
        return PortState("gone", other_ports=list_serial_ports(root))
    if not os.access(path, os.R_OK | os.W_OK, effective_ids=True):
        return PortState("denied")
    port_holders = find_holders(port, root)
    return PortState("held" if port_holders else "there", port_holders)
