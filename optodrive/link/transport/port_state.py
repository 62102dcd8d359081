"""State of a serial port according to the operating system: available, missing, denied, in use or unknown."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from optodrive.core.errors import escape_unprintable

ROOT = Path("/")
SERIAL_NAMES = ("ttyACM*", "ttyUSB*")
PortStatus = Literal["not_a_file", "available", "missing", "denied", "in_use", "unknown"]


@dataclass(frozen=True)
class PortHolder:
    """Process that has a port open."""

    pid: int
    command: str

    def __str__(self) -> str:
        return f"{self.command}, process {self.pid}"


@dataclass(frozen=True)
class PortState:
    """State of a port.

    holders: other processes that have it open
    other_ports: serial ports that exist instead of a missing one
    """

    status: PortStatus
    holders: tuple[PortHolder, ...] = ()
    other_ports: tuple[str, ...] = ()


def join_root(root: Path, path: str | Path) -> Path:
    """Return an absolute path inside a folder that represents the root."""
    return root / str(path).lstrip("/")


def resolve_device(port: str, root: Path = ROOT) -> str:
    """Return the device that a port name refers to, with symbolic links resolved: /dev/ttyACM0."""
    return "/" + str(join_root(root, port).resolve().relative_to(root.resolve()))


def list_serial_ports(root: Path = ROOT) -> tuple[str, ...]:
    """Return the existing serial ports of USB devices."""
    found = [path.name for pattern in SERIAL_NAMES for path in join_root(root, "/dev").glob(pattern)]
    return tuple(f"/dev/{name}" for name in sorted(found))


def find_holders(port: str, root: Path = ROOT) -> tuple[PortHolder, ...]:
    """Return the other processes that have the port open, as far as /proc is readable."""
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
        pass  # the process belongs to another user or has just ended
    return found


def read_command_name(pid: int, root: Path = ROOT) -> str:
    """Return the command name of a process, with escapes, because a process chooses it freely."""
    try:
        return escape_unprintable(join_root(root, f"/proc/{pid}/comm").read_text(errors="replace").strip())
    except OSError:
        return "a process"


def read_port_state(port: str, root: Path = ROOT) -> PortState:
    """Return the present state of a port without opening it, `unknown` if the system does not tell it. Never raise."""
    if not port.startswith("/"):
        return PortState("not_a_file")
    try:
        return _read_device_state(port, root)
    except Exception:  # no descriptor is left to look, or the port vanishes meanwhile
        return PortState("unknown")


def _read_device_state(port: str, root: Path) -> PortState:
    path = join_root(root, port)
    try:
        exists = path.exists()
    except PermissionError:
        return PortState("denied")
    if not exists:
        return PortState("missing", other_ports=list_serial_ports(root))
    if not os.access(path, os.R_OK | os.W_OK, effective_ids=True):
        return PortState("denied")
    port_holders = find_holders(port, root)
    return PortState("in_use" if port_holders else "available", port_holders)


def describe_replug(port: str) -> str:
    """Return the cause for a port that failed and is back, while the board did not restart."""
    return (
        f"{port} was missing and is available again: replugged, or a hub failed; check the plug, the cable and the hub"
    )
