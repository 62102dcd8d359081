"""What the doctor looks at of the configured serial port, without opening it."""

import grp
import os
from pathlib import Path

from optodrive.cli.doctor_finding import Finding, ok, problem, warning
from optodrive.device.config import BoardSection
from optodrive.link.transport.port_state import ROOT, command, device_name, holders, serial_ports, under

LATENCY_MAX_MS = 1
RULES = "/etc/udev/rules.d/99-optodrive.rules"
MODEM_MANAGER = "ModemManager"
IGNORED = ("E:ID_MM_DEVICE_IGNORE=1", "E:ID_MM_PORT_IGNORE=1")


def check_port(board: BoardSection, root: Path = ROOT) -> tuple[list[Finding], bool]:
    """Findings, and whether the board may be asked: the port is there, ours to open, and nobody holds it."""
    if board.transport == "simulated":
        return [ok("port", "none: the board is simulated")], True
    port = board.port
    try:
        exists = under(root, port).exists()
    except PermissionError:
        remedy = "name the port in /dev in board.port, or give this user the right to look there"
        return [problem("permission", f"this user may not look for {port}", remedy)], False
    if not exists:
        there = ", ".join(serial_ports(root)) or "no serial port at all"
        remedy = "plug the board in, or name its port in board.port"
        return [problem("port", f"{port} does not exist; there is {there}", remedy)], False
    may_open, held = _permission(port, root), _holders(port, root)
    findings = [ok("port", f"{port} exists"), may_open, held]
    findings += [_name(port, root), _latency(port, root), _modem_manager(port, root)]
    return findings, may_open.grade == held.grade == "ok"


def _permission(port: str, root: Path) -> Finding:
    path = under(root, port)
    if os.access(path, os.R_OK | os.W_OK, effective_ids=True):
        return ok("permission", "this user may open it")
    try:
        group = grp.getgrgid(path.stat().st_gid).gr_name
    except KeyError:  # a group without a name
        group = str(path.stat().st_gid)
    remedy = f"sudo usermod -aG {group} $USER, then log in again"
    return problem("permission", f"this user may not open it; its group is {group}", remedy)


def _holders(port: str, root: Path) -> Finding:
    found = holders(port, root)
    if not found:
        return ok("holder", "no other program has it open")
    names = "; ".join(map(str, found))
    if any(holder.command == MODEM_MANAGER for holder in found):
        return problem("holder", f"held by {names}", "tell ModemManager to ignore it, see below")
    remedy = "if that is the daemon, `optodrive status` tells of the board; else end it"
    return warning("holder", f"held by {names}: the board is left alone", remedy)


def _name(port: str, root: Path) -> Finding:
    device = device_name(port, root)
    if port != device or not device.startswith(("/dev/ttyACM", "/dev/ttyUSB")):
        return ok("name", f"{port} is {device}" if port != device else port)
    by_id = under(root, "/dev/serial/by-id")
    for link in sorted(by_id.iterdir()) if by_id.is_dir() else ():
        if link.resolve() == under(root, device).resolve():
            remedy = f'board.port = "/dev/serial/by-id/{link.name}"'
            return warning("name", f"{port} may be another device's name after the next start", remedy)
    return warning(
        "name", f"{port} may be another device's name after the next start", "no by-id link: name it by udev"
    )


def _latency(port: str, root: Path) -> Finding:
    device = device_name(port, root)
    path = under(root, f"/sys/class/tty/{Path(device).name}/device/latency_timer")
    try:
        latency_ms = int(path.read_text())
    except (OSError, ValueError):
        return ok("latency", "no FTDI converter, nothing to set")
    if latency_ms > LATENCY_MAX_MS:
        rule = f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{{latency_timer}}="1" in {RULES}'
        return warning("latency", f"the FTDI converter holds bytes back for {latency_ms} ms", rule)
    return ok("latency", f"{latency_ms} ms")


def _modem_manager(port: str, root: Path) -> Finding:
    device = device_name(port, root)
    running = any(command(int(process.name), root) == MODEM_MANAGER for process in under(root, "/proc").glob("[0-9]*"))
    if not running:
        return ok("modem manager", "does not run")
    if not device.startswith(("/dev/ttyACM", "/dev/ttyUSB")):
        return ok("modem manager", "does not look at this kind of port")
    if _ignored(device, root):
        return ok("modem manager", "runs, and ignores this port")
    rule = f'SUBSYSTEM=="tty", ATTRS{{idVendor}}=="…", ENV{{ID_MM_DEVICE_IGNORE}}="1" in {RULES}'
    return warning("modem manager", "runs, and writes to new ports to see whether they are modems", rule)


def _ignored(device: str, root: Path) -> bool:
    try:
        number = under(root, f"/sys/class/tty/{Path(device).name}/dev").read_text().strip()
        properties = under(root, f"/run/udev/data/c{number}").read_text().splitlines()
    except OSError:
        return False
    return any(line in IGNORED for line in properties)
