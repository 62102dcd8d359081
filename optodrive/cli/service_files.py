"""The files of the systemd service: content, paths, and detection of edits."""

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Literal, Self

from optodrive.cli.service_program import check_program
from optodrive.core.errors import InputError, RefusedError, refuse_os_error
from optodrive.core.files import lock_folder, read_regular_file, write_text
from optodrive.core.toml_model import parse_toml
from optodrive.device.config import Config
from optodrive.device.config_file import DEFAULT_CONFIG, build_config, list_named_files, load_config, locate_shipped
from optodrive.device.config_sections import BoardSection


@dataclass(frozen=True)
class ServicePaths:
    """Places of a service's files, which contain the name of a further service on the host."""

    name: str = ""

    def __post_init__(self) -> None:
        if self.name and not re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,31}", self.name):
            raise InputError("--name", self.name, "up to 32 of a to z, 0 to 9, - and _, a letter or digit first")

    @classmethod
    def from_option(cls, name: str | None) -> Self:
        """Build the paths of the service that --name states. Raise InputError, also for an empty name."""
        if name == "":
            raise InputError("--name", name, "a name, or no --name for the first service of this host")
        return cls(name or "")

    @property
    def program(self) -> str:
        """Name of folders and files: optodrive, or optodrive-NAME."""
        return f"optodrive-{self.name}" if self.name else "optodrive"

    @property
    def unit_name(self) -> str:
        """Name of the unit, without its suffix."""
        return f"optodrive@{self.name}" if self.name else "optodrive"

    @property
    def unit(self) -> Path:
        """The unit."""
        return Path(f"/etc/systemd/system/{self.unit_name}.service")

    @property
    def config(self) -> Path:
        """The configuration."""
        return Path("/etc/optodrive") / self.name / "config.toml"

    @property
    def manifest(self) -> Path:
        """The list of installed files."""
        return self.config.with_name("installed.json")

    @property
    def users(self) -> Path:
        """The daemon's user."""
        return Path(f"/etc/sysusers.d/{self.program}.conf")

    @property
    def rules(self) -> Path:
        """The rules for the boards."""
        return Path(f"/etc/udev/rules.d/60-{self.program}.rules")

    @property
    def device_link(self) -> str:
        """Persistent name of the board."""
        return "/dev/optodrive-board" + (f"-{self.name}" if self.name else "")

    @property
    def daemon_paths(self) -> dict[str, str]:
        """Files of the daemon by key of its section."""
        return {
            "socket": f"/run/{self.program}/optodrive.sock",
            "tokens": f"/var/lib/{self.program}/tokens.toml",
            "audit": f"/var/lib/{self.program}/audit.jsonl",
        }


CONFIG_PATH, UNIT_PATH = ServicePaths().config, ServicePaths().unit
FORMAT, VERSION = "optodrive-service", 1
BYTES_MAX = 16_000_000
"""Largest size of a file that is installed, bytes: that of a pixel map."""
DAEMON_HEADER = re.compile(r"^[ \t]*\[[ \t]*daemon[ \t]*\][ \t]*(?:#.*)?(?:\n|\Z)", re.MULTILINE)
RULES = (
    'SUBSYSTEM=="tty", {board}, ENV{{ID_MM_DEVICE_IGNORE}}="1", GROUP="dialout", MODE="0660", SYMLINK+="{link}"\n'
    'SUBSYSTEM=="usb", ENV{{DEVTYPE}}=="usb_device", {board}, ENV{{ID_MM_DEVICE_IGNORE}}="1", GROUP="dialout", '
    'MODE="0660"'
)
ALLOWED_CLASSES = ("ttyACM", "ttyUSB")
"""Classes of serial devices that the unit allows for every configuration: those of adapters and boards on USB."""
USB_UNIT_LINES = """DeviceAllow=char-usb_device rw
# libusb detects devices over netlink.
RestrictAddressFamilies=AF_NETLINK
"""
FileStatus = Literal["missing", "as installed", "edited"]


@dataclass(frozen=True)
class ServiceFile:
    """A file of the service: absolute path, text, and whether an edited file is kept instead of being an obstacle."""

    path: Path
    text: str
    preserve_edits: bool = False


def list_units(root: Path) -> list[str]:
    """Return the units of all services that are installed below a root."""
    found = (root / "etc/optodrive").glob("**/installed.json")
    folders = sorted(path.parent.relative_to(root / "etc/optodrive") for path in found)
    return [ServicePaths("" if folder == Path() else folder.name).unit_name for folder in folders]


def build_service_files(
    source: str | Path | None, program: Path, paths: ServicePaths = ServicePaths()
) -> tuple[Config, list[ServiceFile]]:
    """Build the configuration and every file of an installation.

    Raises InputError for values that cannot be used, and RefusedError for a program that the service cannot access.
    """
    config, text = _load_configuration(source, paths)
    files = [
        ServiceFile(paths.unit, _render_unit(config, program, paths)),
        ServiceFile(paths.users, locate_shipped("systemd", "optodrive.sysusers").read_text("utf-8")),
        ServiceFile(paths.config, text, preserve_edits=True),
        *_copy_named_files(_locate_configuration(source), text, paths),
    ]
    rules = "\n".join(_render_rules(config, paths))
    if rules:
        text = locate_shipped("systemd", "optodrive.rules").read_text("utf-8")
        files.append(ServiceFile(paths.rules, text.replace("@RULES@", rules)))
    return config, files


def list_serial_ports(config: Config) -> list[tuple[str, str]]:
    """Return the serial ports that a configuration names, with their keys."""
    stages = config.list_stage_configs()
    prefixes = [f"stages.{stage.stages[0].name}." if config.stages else "" for stage in stages]
    ports = [
        (f"{prefix}board.port", stage.board.port)
        for prefix, stage in zip(prefixes, stages, strict=True)
        if stage.board.transport == "serial"
    ]
    return ports if config.sensor is None else [*ports, ("sensor.port", config.sensor.port)]


def find_device_class(port: str) -> str | None:
    """Return the class in /proc/devices of a serial port, None if its name does not tell and it is not present."""
    if port.startswith((ServicePaths().device_link, "/dev/serial/by-")):
        return ALLOWED_CLASSES[0]  # what udev names so is on USB
    match = re.fullmatch(r"/dev/(tty[A-Z]+)\d+", os.path.realpath(port))
    return None if match is None else match[1]


def check_other_services(root: Path, paths: ServicePaths, config: Config, is_stated: bool) -> None:
    """Raise RefusedError where an installation would take away another display's service, port or board.

    is_stated: whether the caller names the configuration; otherwise it is the installed one
    """
    folder = root / "etc/optodrive"
    for installed in sorted([*folder.glob("config.toml"), *folder.glob("*/config.toml")]):
        try:
            other = load_config(installed)
        except InputError:
            continue  # the service cannot start with it
        if installed == root / paths.config.relative_to("/"):
            if is_stated and other.name != config.name:
                raise RefusedError(
                    f"{installed}: this service drives {other.name}, the configuration is of {config.name}; "
                    "--name NAME installs a further service, `optodrive service remove` removes this one"
                )
        elif other.daemon.port == config.daemon.port:
            raise RefusedError(f"{installed}: this service has daemon.port {config.daemon.port}, too: state another")
        elif (shared := set(_list_addresses(other)) & set(_list_addresses(config))) != set():
            raise RefusedError(f"{installed}: this service has the board {' '.join(map(str, shared.pop()))}, too")


def _list_addresses(config: Config) -> list[tuple[str | int | None, ...]]:
    return [stage.board.address for stage in config.list_stage_configs() if stage.board.address]


def _load_configuration(source: str | Path | None, paths: ServicePaths) -> tuple[Config, str]:
    load_config(source)  # reports errors under the given name
    path = _locate_configuration(source)
    text = _add_daemon_paths(_read_text(path), str(path), paths.daemon_paths)
    return build_config(path, parse_toml(text.encode(), str(path))), text


def _locate_configuration(source: str | Path | None) -> Path:
    path = Path(DEFAULT_CONFIG if source is None else source)
    return path if path.exists() else locate_shipped(f"{path}.toml")


def _copy_named_files(path: Path, text: str, paths: ServicePaths) -> list[ServiceFile]:
    """Build the copies, for the configuration's new folder, of the files that it names relative to its own.

    Raises InputError for a file that cannot be read, or has no place there.
    """
    folder = paths.config.parent
    copies = {}
    for section, key in list_named_files(parse_toml(text.encode(), str(path))):
        name = Path(section[key])
        if name.is_absolute():
            continue
        if ".." in name.parts or folder / name in (paths.config, paths.manifest):
            expected = f"an absolute path, or a file in the configuration's folder that {folder} has no other of"
            raise InputError(f"{path}: {key}", str(name), expected)
        copies[folder / name] = ServiceFile(folder / name, _read_text(path.parent / name), preserve_edits=True)
    return list(copies.values())


def _add_daemon_paths(text: str, where: str, daemon_paths: dict[str, str]) -> str:
    """Return a configuration with the service's paths for the keys that its section [daemon] does not state."""
    stated = parse_toml(text.encode(), where).get("daemon", {})
    missing = "".join(f'{key} = "{value}"\n' for key, value in daemon_paths.items() if key not in stated)
    if not missing:
        return text
    header = DAEMON_HEADER.search(text)
    if header is not None:
        return f"{text[: header.end()].rstrip()}\n{missing}{text[header.end() :]}"
    if stated:
        keys = ", ".join(key for key in daemon_paths if key not in stated)
        raise InputError(f"{where}: daemon", stated, f"a section [daemon], or all of {keys}: the service needs them")
    return f"{text}\n[daemon]\n{missing}"


def _render_unit(config: Config, program: Path, paths: ServicePaths) -> str:
    check_program(program)
    text = locate_shipped("systemd", "optodrive.service").read_text("utf-8").replace("@PROGRAM@", str(program))
    text = text.replace("@CONFIG@", str(paths.config)).replace("@FOLDER@", paths.program)
    found = {find_device_class(port) for _, port in list_serial_ports(config)} - {None, *ALLOWED_CLASSES}
    lines = "".join(f"DeviceAllow=char-{each} rw\n" for each in sorted(filter(None, found)))
    text = text.replace("\nRestrictAddressFamilies=", f"{lines}\nRestrictAddressFamilies=", 1)
    if {stage.board.transport for stage in config.list_stage_configs()} & {"usb", "helios"}:
        text = text.replace("\nRestrictAddressFamilies=", f"\n{USB_UNIT_LINES}RestrictAddressFamilies=", 1)
    return text


def _render_rules(config: Config, paths: ServicePaths) -> Iterator[str]:
    """Yield the rules of each stage's board that states its USB numbers."""
    for stage in config.list_stage_configs():
        if stage.board.vendor_id is not None and stage.board.product_id is not None:
            suffix = f"-{stage.stages[0].name}" if config.stages else ""
            link = paths.device_link.removeprefix("/dev/") + suffix
            yield RULES.format(board=_match_board(stage.board), link=link)


def _match_board(board: BoardSection) -> str:
    if not re.fullmatch(r"[\w.:-]*", board.serial_number, re.ASCII):
        raise InputError("board.serial_number", board.serial_number, "letters, digits, . : _ and - for a udev rule")
    matches = [f'ATTRS{{idVendor}}=="{board.vendor_id:04x}"', f'ATTRS{{idProduct}}=="{board.product_id:04x}"']
    if board.serial_number:
        matches.append(f'ATTRS{{serial}}=="{board.serial_number}"')
    return ", ".join(matches)


class Installation:
    """The installed files below a root, and the digests of their installed content and, after it, of the one before."""

    def __init__(self, root: Path, paths: ServicePaths = ServicePaths()) -> None:
        self._root, self._manifest = root, paths.manifest
        self._digests = self._load_digests()

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Let one command at a time change the files, from the digests that the last one left."""
        folder = self.resolve(self._manifest).parent
        _make_folder(folder)
        with lock_folder(folder):
            self._digests = self._load_digests()
            yield

    def resolve(self, path: Path) -> Path:
        """Return the path of a file of the service below the root."""
        return self._root / path.relative_to("/")

    def file_status(self, path: Path) -> FileStatus:
        """Return whether a file is missing, as installed, or edited (or created by others)."""
        target = self.resolve(path)
        if not target.exists() and not target.is_symlink():
            return "missing"
        known = self._digests.get(str(path), "").split()
        return "as installed" if _compute_digest(_read_text(target)) in known else "edited"

    def installed_files(self) -> Iterator[Path]:
        """Yield the paths of the installed files."""
        return (Path(path) for path in sorted(self._digests))

    def install(self, files: list[ServiceFile]) -> list[tuple[Path, str]]:
        """Write missing and changed files, and return each path with the action taken.

        Raises RefusedError, before writing anything, where an edited file would be overwritten.
        """
        with self._alone():
            return self._install(files)

    def _install(self, files: list[ServiceFile]) -> list[tuple[Path, str]]:
        edited = [file for file in files if self.file_status(file.path) == "edited"]
        obstacles = [
            str(self.resolve(file.path)) for file in edited if not (file.preserve_edits or self._is_current(file))
        ]
        if obstacles:
            raise RefusedError(
                f"{', '.join(obstacles)}: edited, or not written by `optodrive service install`; nothing was "
                "written. Move it away, and put changes to the unit into a drop-in (systemctl edit optodrive)"
            )
        written = [file for file in files if not (file in edited and file.preserve_edits)]
        for file in written:
            before = self._digests.get(str(file.path), "").split()[:1]
            self._digests[str(file.path)] = " ".join(dict.fromkeys([_compute_digest(file.text), *before]))
        self._save_digests()  # first: wherever the installation ends, the next one knows old and new files as its own
        return [(file.path, self._install_file(file) if file in written else "edited, kept") for file in files]

    def _install_file(self, file: ServiceFile) -> str:
        if self._is_current(file):
            return "unchanged"
        target = self.resolve(file.path)
        action = "replaced" if target.exists() else "written"
        _make_folder(target.parent)
        write_text(target, file.text)
        return action

    def remove(self) -> list[tuple[Path, str]]:
        """Remove the installed files that were not edited, and return each path with the action taken."""
        if not self._digests:
            return []
        with self._alone():
            return self._remove()

    def _remove(self) -> list[tuple[Path, str]]:
        actions = []
        for path in list(self.installed_files()):
            status = self.file_status(path)
            if status == "edited":
                actions.append((path, "edited, kept"))
                continue
            with refuse_os_error(self.resolve(path), "a file that can be removed"):
                self.resolve(path).unlink(missing_ok=True)
            del self._digests[str(path)]
            actions.append((path, "removed" if status == "as installed" else "was missing"))
        self._save_digests()
        folder = self.resolve(self._manifest).parent
        with suppress(OSError):  # a folder with an edited file, or with another service
            folder.rmdir()
            if folder.parent.name == "optodrive":
                folder.parent.rmdir()
        return actions

    def _is_current(self, file: ServiceFile) -> bool:
        target = self.resolve(file.path)
        return target.is_file() and _read_text(target) == file.text

    def _load_digests(self) -> dict[str, str]:
        target = self.resolve(self._manifest)
        if not target.exists():
            return {}
        try:
            document = json.loads(_read_text(target))
            file_format, files = (document["format"], document["version"]), dict(document["sha256"])
        except (ValueError, KeyError, TypeError, RecursionError):
            file_format, files = None, {}
        if file_format != (FORMAT, VERSION):
            raise InputError(str(target), "another format", f"{FORMAT} version {VERSION}")
        return {str(path): str(digest) for path, digest in files.items()}

    def _save_digests(self) -> None:
        target = self.resolve(self._manifest)
        if not self._digests:
            target.unlink(missing_ok=True)
            return
        _make_folder(target.parent)
        document = {"format": FORMAT, "version": VERSION, "sha256": self._digests}
        write_text(target, json.dumps(document, indent=2) + "\n")


def _compute_digest(text: str) -> str:
    return sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


def _read_text(path: Path) -> str:
    return read_regular_file(path, BYTES_MAX).decode("utf-8", "surrogateescape").replace("\r\n", "\n")


def _make_folder(folder: Path) -> None:
    with refuse_os_error(folder, "a folder that can be created (as root, or with --root)"):
        folder.mkdir(parents=True, exist_ok=True)
