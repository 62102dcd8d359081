"""Checks of the configured serial port, without opening it."""

import grp
import os
import re
from pathlib import Path
from typing import NamedTuple

from optodrive.cli.output import Finding, report_ok, report_problem, report_warning
from optodrive.core.errors import escape_unprintable
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
BRLTTY = "brltty"
SERIAL_ADAPTERS = ("0403:6001", "0403:6015", "067b:2303", "10c4:ea60", "1a86:7523", "1a86:55d4")
"""FT232R, FT231X, PL2303, CP210x, CH340 and CH9102."""
RULES_FOLDERS = ("/etc/udev/rules.d", "/run/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
PRODUCT_RULE = re.compile(r'ENV\{PRODUCT\}=="([0-9a-f]{1,4})/([0-9a-f]{1,4})/')
IDS_RULE = re.compile(r'ATTRS?\{idVendor\}=="([0-9a-f]{4})".*ATTRS?\{idProduct\}=="([0-9a-f]{4})"')
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
        absent = report_problem("port", f"{port} does not exist; found: {available}", remedy)
        return [absent, *_check_brltty(port, root)], False
    permission, holder = _check_permission(port, root), _check_holders(port, root)
    findings = [report_ok("port", f"{port} exists"), permission, holder]
    findings += [_check_name(port, root), _check_latency(port, root), _check_modem_manager(port, root)]
    findings += _check_brltty(port, root)
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


class UsbIdentity(NamedTuple):
    """Identity of the USB device behind a serial port.

    folder: of the device in sysfs; ids: vendor and product; serial: its serial number, '' without one
    """

    folder: Path
    ids: str
    serial: str


def _read_usb(device: str, root: Path) -> UsbIdentity | None:
    """Return the USB device behind a port, None if there is none."""
    folder = join_root(root, f"/sys/class/tty/{Path(device).name}/device").resolve()
    for each in (folder, *folder.parents):
        if (each / "idVendor").is_file():
            serial = _read_text(each / "serial")
            return UsbIdentity(each, f"{_read_text(each / 'idVendor')}:{_read_text(each / 'idProduct')}", serial)
    return None


def _read_text(path: Path) -> str:
    try:
        return escape_unprintable(path.read_text(errors="replace").strip())
    except OSError:
        return ""


def _find_link(folder: str, device: str, root: Path) -> str | None:
    """Return the name in a folder of /dev/serial that is a link to a device, None without one."""
    links = join_root(root, f"/dev/serial/{folder}")
    for link in sorted(links.iterdir()) if links.is_dir() else ():
        if link.resolve() == join_root(root, device).resolve():
            return f"/dev/serial/{folder}/{link.name}"
    return None


def _check_name(port: str, root: Path) -> Finding:
    device = resolve_device(port, root)
    if not device.startswith(("/dev/ttyACM", "/dev/ttyUSB")):
        return report_ok("name", f"{port} is {device}" if port != device else port)
    by_path = _find_link("by-path", device, root)
    place_remedy = f'board.port = "{by_path}", the place of its plug' if by_path else "give it a name with a udev rule"
    usb, is_by_id = _read_usb(device, root), "/by-id/" in port
    if port != device and not is_by_id:
        return report_ok("name", f"{port} is {device}")
    twins = [] if usb is None else [other for other in list_serial_ports(root) if _are_twins(usb, other, root)]
    if usb is not None and twins:
        number = f"the serial number {usb.serial!r} as well" if usb.serial else "no serial number"
        shared = (
            f"{', '.join([device, *twins])} are adapters of one kind ({usb.ids}) with {number}: they share a by-id name"
        )
        report = report_problem if is_by_id else report_warning
        return report("name", f"{shared}, which belongs to the one that was plugged in last", place_remedy)
    if usb is not None and not usb.serial:
        observation = f"{device} is an adapter without a serial number: a second one of its kind takes its by-id name"
        return report_warning("name", observation, place_remedy)
    if is_by_id:
        return report_ok("name", f"{port} is {device}")
    by_id = _find_link("by-id", device, root)
    remedy = f'board.port = "{by_id}"' if by_id else f"no by-id link: {place_remedy}"
    return report_warning("name", f"{port} may be another device's name after the next start", remedy)


def _are_twins(usb: UsbIdentity, other: str, root: Path) -> bool:
    """Return whether another port belongs to another device that nothing but its place tells from this one."""
    its = _read_usb(other, root)
    return its is not None and its.folder != usb.folder and its[1:] == usb[1:]


# --- BRLTTY ---------------------------------------------------------------------------------------------------------


def _check_brltty(port: str, root: Path) -> list[Finding]:
    """Return whether BRLTTY takes the adapter of a port, or has taken one, and nothing without a sign of it."""
    rules = _read_brltty_rules(root)
    usb = _read_usb(resolve_device(port, root), root)
    if usb is not None:
        if usb.ids not in rules:
            return []
        observation = f"BRLTTY takes adapters of this kind ({usb.ids}) for braille displays, and the port then vanishes"
        return [report_warning("brltty", observation, _describe_brltty_remedy(rules[usb.ids]))]
    taken = [ids for ids in _list_portless_adapters(root, {*rules, *SERIAL_ADAPTERS}) if ids]
    if not taken:
        return []
    is_running = BRLTTY in _list_commands(root)
    holder = "BRLTTY, which runs, has taken it" if is_running else "a program has taken it by libusb"
    observation = f"an adapter ({', '.join(taken)}) is connected and has no serial port: {holder}"
    rule = next((rules[ids] for ids in taken if ids in rules), "")
    return [report_problem("brltty", observation, _describe_brltty_remedy(rule))]


def _describe_brltty_remedy(rule: str) -> str:
    mask = f"sudo ln -s /dev/null /etc/udev/rules.d/{rule} && sudo udevadm control --reload, " if rule else ""
    return f"{mask}end BRLTTY, and plug the adapter in again; name BRLTTY's own display in /etc/brltty.conf"


def _read_brltty_rules(root: Path) -> dict[str, str]:
    """Return the ids of devices that BRLTTY's udev rules take by these alone, with the file's name."""
    files: dict[str, Path] = {}
    for folder in RULES_FOLDERS:  # the first file of a name replaces the others
        for path in sorted(join_root(root, folder).glob("*brltty*.rules")):
            files.setdefault(path.name, path)
    found = {}
    for name, path in files.items():
        if path.is_symlink() and str(path.readlink()) == "/dev/null":
            continue
        for line in _read_text_lines(path):
            match = PRODUCT_RULE.search(line) or IDS_RULE.search(line)
            if match and not line.startswith("#") and "manufacturer" not in line and "ATTRS{product}" not in line:
                found[f"{match[1].zfill(4)}:{match[2].zfill(4)}"] = name
    return found


def _read_text_lines(path: Path) -> list[str]:
    try:
        return [line.strip() for line in path.read_text(errors="replace").splitlines()]
    except OSError:
        return []


def _list_portless_adapters(root: Path, known: set[str]) -> list[str]:
    """Return the ids of connected adapters that a program holds by libusb, so that they have no serial port."""
    found = []
    for device in sorted(join_root(root, "/sys/bus/usb/devices").glob("*")):
        ids = f"{_read_text(device / 'idVendor')}:{_read_text(device / 'idProduct')}"
        if ids in known and any(driver.resolve().name == "usbfs" for driver in device.glob("*/driver")):
            found.append(ids)
    return found


def _list_commands(root: Path) -> set[str]:
    """Return the names of the running commands."""
    processes = join_root(root, "/proc").glob("[0-9]*")
    return {read_command_name(int(process.name), root) for process in processes}


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
    if MODEM_MANAGER not in _list_commands(root):
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
