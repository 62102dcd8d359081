"""The files of the service: what is in them, where they lie, and which of them somebody has edited."""

import json
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Literal

from optodrive.core.errors import InputError, RefusedError
from optodrive.core.files import written_whole
from optodrive.device.config import DEFAULT_CONFIG, Config, load_config, shipped_path

CONFIG = Path("/etc/optodrive/config.toml")
UNIT = Path("/etc/systemd/system/optodrive.service")
USERS = Path("/etc/sysusers.d/optodrive.conf")
RULES = Path("/etc/udev/rules.d/60-optodrive.rules")
INSTALLED = Path("/etc/optodrive/installed.json")
FORMAT, VERSION = "optodrive-service", 1
LINK = "/dev/optodrive-board"
HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108 - what the unit does not see
DAEMON = {
    "socket": "/run/optodrive/optodrive.sock",
    "tokens": "/var/lib/optodrive/tokens.toml",
    "audit": "/var/lib/optodrive/audit.jsonl",
}
USB_ONLY = """DeviceAllow=char-usb_device rw
# libusb learns of devices over netlink.
RestrictAddressFamilies=AF_NETLINK
"""
Standing = Literal["missing", "as installed", "edited"]


@dataclass(frozen=True)
class ServiceFile:
    """A file of the service. path: from the root; kept: an edited one is left as it is and is no obstacle."""

    path: Path
    text: str
    kept: bool = False


def service_files(source: str | Path | None, program: Path) -> tuple[Config, list[ServiceFile]]:
    """The configuration, and every file that an installation has; InputError or RefusedError for what cannot be."""
    config, text = _configuration(source)
    files = [
        ServiceFile(UNIT, _unit(config, program)),
        ServiceFile(USERS, shipped_path("systemd", "optodrive.sysusers").read_text("utf-8")),
        ServiceFile(CONFIG, text, kept=True),
    ]
    if config.board.vendor_id is not None and config.board.product_id is not None:
        files.append(ServiceFile(RULES, _rules(config)))
    return config, files


def _configuration(source: str | Path | None) -> tuple[Config, str]:
    load_config(source)  # says what is wrong by the name that was given
    path = Path(DEFAULT_CONFIG if source is None else source)
    text = (path if path.exists() else shipped_path(f"{path}.toml")).read_text("utf-8")
    if not re.search(r"^\s*\[daemon\]", text, re.MULTILINE):
        text += "\n[daemon]\n" + "".join(f'{key} = "{value}"\n' for key, value in DAEMON.items())
    with tempfile.NamedTemporaryFile("w", suffix=".toml", encoding="utf-8") as whole:
        whole.write(text)
        whole.flush()
        return load_config(whole.name), text


def _unit(config: Config, program: Path) -> str:
    if not program.is_absolute() or any(c.isspace() or c in "%$\"'\\" for c in str(program)):
        raise InputError("--program", str(program), "an absolute path of plain characters")
    hidden = next((folder for folder in HIDDEN if program.is_relative_to(folder)), None)
    if hidden is not None:
        raise RefusedError(
            f"the service sees nothing below {hidden}, and {program} lies there; install optodrive where all may read "
            "it (python3 -m venv /opt/optodrive), and run its `optodrive service install`, or name it with --program"
        )
    text = shipped_path("systemd", "optodrive.service").read_text("utf-8").replace("@PROGRAM@", str(program))
    if config.board.transport in ("usb", "helios"):
        text = text.replace("\nRestrictAddressFamilies=", f"\n{USB_ONLY}RestrictAddressFamilies=", 1)
    return text


def _rules(config: Config) -> str:
    board = config.board
    if not re.fullmatch(r"[\w.:-]*", board.serial_number, re.ASCII):
        raise InputError("board.serial_number", board.serial_number, "letters, digits, . : _ and - for a udev rule")
    matches = [f'ATTRS{{idVendor}}=="{board.vendor_id:04x}"', f'ATTRS{{idProduct}}=="{board.product_id:04x}"']
    if board.serial_number:
        matches.append(f'ATTRS{{serial}}=="{board.serial_number}"')
    return shipped_path("systemd", "optodrive.rules").read_text("utf-8").replace("@BOARD@", ", ".join(matches))


class Installation:
    """The files below a root, and what is remembered of what was put there."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._known = self._remembered()

    def place(self, path: Path) -> Path:
        """Where a file of the service lies below the root."""
        return self._root / path.relative_to("/")

    def standing(self, path: Path) -> Standing:
        """How a file stands: as it was put there, edited since (or put there by others), or not there."""
        place = self.place(path)
        if not place.exists() and not place.is_symlink():
            return "missing"
        return "as installed" if _digest(_read(place)) == self._known.get(str(path)) else "edited"

    def known(self) -> Iterator[Path]:
        """The files that were put there."""
        return (Path(path) for path in sorted(self._known))

    def put(self, files: list[ServiceFile]) -> list[tuple[Path, str]]:
        """Write what is not there yet or has changed; each file and what was done.

        RefusedError, before anything is written, where that would overwrite what somebody edited.
        """
        edited = [file for file in files if self.standing(file.path) == "edited"]
        obstacles = [str(self.place(file.path)) for file in edited if not (file.kept or self._same(file))]
        if obstacles:
            raise RefusedError(
                f"{', '.join(obstacles)}: edited, or not put there by `optodrive service install`; nothing was "
                "written. Move it away, and keep changes to the unit in a drop-in (systemctl edit optodrive)"
            )
        done = [(file.path, self._put(file, file in edited)) for file in files]
        self._remember()
        return done

    def _put(self, file: ServiceFile, edited: bool) -> str:
        if edited and file.kept:
            return "edited, left as it is"
        self._known[str(file.path)] = _digest(file.text)
        if self._same(file):
            return "there already"
        place = self.place(file.path)
        done = "replaced" if place.exists() else "written"
        _make_folder(place.parent)
        with written_whole(place) as temporary:
            temporary.write_text(file.text, encoding="utf-8")
        return done

    def take_away(self) -> list[tuple[Path, str]]:
        """Remove what was put there and is as it was; each file and what was done."""
        done = []
        for path in list(self.known()):
            standing = self.standing(path)
            if standing == "edited":
                done.append((path, "edited, left as it is"))
                continue
            try:
                self.place(path).unlink(missing_ok=True)
            except OSError as error:
                raise InputError(str(self.place(path)), error.strerror, "a file that may be removed") from None
            del self._known[str(path)]
            done.append((path, "removed" if standing == "as installed" else "was not there"))
        self._remember()
        return done

    def _same(self, file: ServiceFile) -> bool:
        place = self.place(file.path)
        return place.is_file() and _read(place) == file.text

    def _remembered(self) -> dict[str, str]:
        place = self.place(INSTALLED)
        if not place.exists():
            return {}
        try:
            document = json.loads(_read(place))
            form, files = (document["format"], document["version"]), dict(document["sha256"])
        except (ValueError, KeyError, TypeError):
            form, files = None, {}
        if form != (FORMAT, VERSION):
            raise InputError(str(place), "another format", f"{FORMAT} version {VERSION}")
        return {str(path): str(digest) for path, digest in files.items()}

    def _remember(self) -> None:
        place = self.place(INSTALLED)
        if not self._known:
            place.unlink(missing_ok=True)
            return
        _make_folder(place.parent)
        with written_whole(place) as temporary:
            document = {"format": FORMAT, "version": VERSION, "sha256": self._known}
            temporary.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def _digest(text: str) -> str:
    return sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


def _read(place: Path) -> str:
    try:
        return place.read_text("utf-8", "surrogateescape")
    except OSError as error:
        raise InputError(str(place), error.strerror, "a readable file") from None


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(str(folder), error.strerror, "a folder that may be made (as root, or with --root)") from None
