"""Checks of the configured serial port, without opening it."""

import grp
import os
from pathlib import Path

from optodrive.cli.doctor_finding import Finding, report_ok, report_problem, report_warning
from optodrive.device.config_sections import BoardSection
from optodrive.link.transport.port_state import (
    ROOT,
    find_holders,
    join_root,
    list_serial_ports,
    read_command_name,
    resolve_device,
)

LATENCY_MAX_MS = 1
UDEV_RULES = "/etc/udev/rules.d/99-optodrive.rules"
MODEM_MANAGER = "ModemManager"
IGNORE_PROPERTIES = ("E:ID_MM_DEVICE_IGNORE=1", "E:ID_MM_PORT_IGNORE=1")


def check_port(board: BoardSection, root: Path = ROOT) -> tuple[list[Finding], bool]:
    """Return the findings, and whether the board can be contacted: the port exists, may be opened and is not in use."""
    if board.transport != "serial":
        reason = "the board is simulated" if board.transport == "simulated" else f"transport {board.transport}"
        return [report_ok("port", f"none: {reason}")], True
    port = board.port
    try:
        exists = join_root(root, port).exists()
    except PermissionError:
        remedy = "name a port in /dev in board.port, or give this user access to that folder"
        return [report_problem("permission", f"this user has no access to the folder of {port}", remedy)], False
    if not exists:
        available = ", ".join(list_serial_ports(root)) or "no serial port"
        remedy = "connect the board, or name its port in board.port"
        return [report_problem("port", f"{port} does not exist; found: {available}", remedy)], False
    permission, holder = _check_permission(port, root), _check_holders(port, root)
    findings = [report_ok("port", f"{port} exists"), permission, holder]
    findings += [_check_name(port, root), _check_latency(port, root), _check_modem_manager(port, root)]
    return findings, permission.status == holder.status == "ok"


def _check_permission(port: str, root: Path) -> Finding:
    path = join_root(root, port)
    if os.access(path, os.R_OK | os.W_OK, effective_ids=True):
        return report_ok("permission", "this user may open it")
    try:
        group = grp.getgrgid(path.stat().st_gid).gr_name
    except KeyError:  # a group without a name
        group = str(path.stat().st_gid)
    remedy = f"sudo usermod -aG {group} $USER, then log in again"
    return report_problem("permission", f"this user may not open it; its group is {group}", remedy)


def _check_holders(port: str, root: Path) -> Finding:
    port_holders = find_holders(port, root)
    if not port_holders:
        return report_ok("holder", "no other program has it open")
    names = "; ".join(map(str, port_holders))
    if any(holder.command == MODEM_MANAGER for holder in port_holders):
        return report_problem("holder", f"held by {names}", "configure ModemManager to ignore it, see below")
    remedy = "if this is the daemon, `optodrive status` reports the board; otherwise end it"
    return report_warning("holder", f"held by {names}: the board is not contacted", remedy)


def _check_name(port: str, root: Path) -> Finding:
    device = resolve_device(port, root)
    if port != device or not device.startswith(("/dev/ttyACM", "/dev/ttyUSB")):
        return report_ok("name", f"{port} is {device}" if port != device else port)
    by_id = join_root(root, "/dev/serial/by-id")
    for link in sorted(by_id.iterdir()) if by_id.is_dir() else ():
        if link.resolve() == join_root(root, device).resolve():
            remedy = f'board.port = "/dev/serial/by-id/{link.name}"'
            return report_warning("name", f"{port} may be another device's name after the next start", remedy)
    return report_warning(
        "name",
        f"{port} may be another device's name after the next start",
        "no by-id link: give it a name with a udev rule",
    )


def _check_latency(port: str, root: Path) -> Finding:
    device = resolve_device(port, root)
    path = join_root(root, f"/sys/class/tty/{Path(device).name}/device/latency_timer")
    try:
        latency_ms = int(path.read_text())
    except (OSError, ValueError):
        return report_ok("latency", "no FTDI converter")
    if latency_ms > LATENCY_MAX_MS:
        rule = f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{{latency_timer}}="1" in {UDEV_RULES}'
        return report_warning("latency", f"the FTDI converter delays bytes by {latency_ms} ms", rule)
    return report_ok("latency", f"{latency_ms} ms")


def _check_modem_manager(port: str, root: Path) -> Finding:
    device = resolve_device(port, root)
    running = any(
        read_command_name(int(process.name), root) == MODEM_MANAGER
        for process in join_root(root, "/proc").glob("[0-9]*")
    )
    if not running:
        return report_ok("modem manager", "does not run")
    if not device.startswith(("/dev/ttyACM", "/dev/ttyUSB")):
        return report_ok("modem manager", "does not probe this kind of port")
    if _is_ignored(device, root):
        return report_ok("modem manager", "runs, and ignores this port")
    rule = f'SUBSYSTEM=="tty", ATTRS{{idVendor}}=="…", ENV{{ID_MM_DEVICE_IGNORE}}="1" in {UDEV_RULES}'
    return report_warning("modem manager", "runs, and probes new ports for modems by writing to them", rule)


def _is_ignored(device: str, root: Path) -> bool:
    try:
        number = join_root(root, f"/sys/class/tty/{Path(device).name}/dev").read_text().strip()
        properties = join_root(root, f"/run/udev/data/c{number}").read_text().splitlines()
    except OSError:
        return False
    return any(line in IGNORE_PROPERTIES for line in properties)
