"""The entries of a support archive, without secrets. A source that cannot be read is an entry that says why.

Removed are known secrets in every form, and values that are named as a secret.
"""

import gzip
import io
import json
import os
import platform
import re
import subprocess
import sys
import tarfile
from base64 import b64encode, urlsafe_b64encode
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from importlib.metadata import distributions
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

from optodrive.cli.service_files import CONFIG_PATH, UNIT_PATH
from optodrive.core.daemon_url import VARIABLE_PREFIX
from optodrive.core.errors import OptodriveError
from optodrive.core.files import read_last_lines
from optodrive.daemon.api.tokens import (
    ENVIRONMENT_VARIABLE,
    FILE_ENVIRONMENT_VARIABLE,
    SERVICE_TOKENS,
    build_tokens_path,
    read_tokens,
)
from optodrive.device.config_file import list_shipped_configs, load_config, locate_shipped

if TYPE_CHECKING:
    from optodrive.device.config import Config


REMOVED = "<removed>"
VALUE = r"""("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[^\s"',;&]+)"""
NAMED = re.compile(
    r"""(?i)((?:secret|token|password|passwd|passphrase|api[_-]?key|optodrive-\d+)\\?["']?\s*[=:]\s*)""" + VALUE
)
"""A value behind the name of a secret: in TOML, JSON, an environment, a query or a cookie."""
CREDENTIALS = re.compile(r"(?i)\b((?:bearer[ .]|basic )\s*)[!-~]{8,}")
"""What a header or a subprotocol presents."""


class Redaction:
    """Removes secrets. secrets: those that are known."""

    def __init__(self, secrets: Iterable[str]) -> None:
        forms = {form for secret in secrets for form in _list_forms(secret)}
        self._known = sorted(forms, key=len, reverse=True)  # no form may hide a part of a longer one

    def redact(self, text: str) -> str:
        """Return the text without secrets."""
        for form in self._known:
            text = text.replace(form, REMOVED)
        return CREDENTIALS.sub(rf"\1{REMOVED}", NAMED.sub(rf"\1{REMOVED}", text))


def _list_forms(secret: str) -> list[str]:
    """Return a secret as it stands in text, JSON, an address, and the base64 of a header or a subprotocol."""
    data = secret.encode()
    encoded = (b64encode(data).decode(), urlsafe_b64encode(data).decode())
    return [secret, json.dumps(secret)[1:-1], quote(secret, safe=""), *(text.rstrip("=") for text in encoded)]


ENTRY_MAX_BYTES = 2_000_000
"""Largest size of an entry, of whose source the end is kept."""
JOURNAL = ("journalctl", "--unit=optodrive", "--lines=5000", "--no-pager", "--output=short-iso-precise")
JOURNAL_TIMEOUT_S = 20.0
DAEMON_TIMEOUT_S = 5.0
VARIABLES = (VARIABLE_PREFIX, "NUMBA_", "XDG_RUNTIME_DIR", "LANG")
"""Beginnings of the names of environment variables that matter here."""


class Entry(NamedTuple):
    """A file of the archive."""

    name: str
    text: str


def collect_entries(source: str | None, url: str, logs: list[Path]) -> list[Entry]:
    """Collect all entries, without secrets.

    source: configuration file or shipped name; logs: besides the journal
    """
    path = _find_config(source)
    config: Config | None = None
    with suppress(OptodriveError):
        config = load_config(path)
    redaction = Redaction(_list_secrets(config))
    readers: dict[str, Callable[[], str]] = {
        "versions.txt": _describe_versions,
        "environment.txt": _describe_environment,
        "configuration/config.toml": lambda: _read_file(path),
        **{f"configuration/{name}": _reader(named) for name, named in _list_named_files(config)},
        "configuration/check.txt": lambda: _check_config(path),
        "service/optodrive.service": lambda: _read_file(UNIT_PATH),
        "daemon/state.json": lambda: _read_state(url),
        "logs/journal.txt": _read_journal,
        **{f"logs/{number}-{each.name}": _reader(each) for number, each in enumerate(logs)},
    }
    if config is not None and config.daemon.audit:
        readers["logs/audit.jsonl"] = _reader(Path(config.daemon.audit))
    return [Entry(redaction.redact(name), redaction.redact(_run(read))) for name, read in readers.items()]


def build_archive(entries: list[Entry]) -> bytes:
    """Return a .tar.gz of the entries, without the names and the times of this computer."""
    buffer = io.BytesIO()
    with (
        gzip.GzipFile(filename="", mode="wb", fileobj=buffer, mtime=0) as packed,
        tarfile.open(fileobj=packed, mode="w") as archive,
    ):
        for entry in entries:
            content = entry.text.encode("utf-8", "replace")
            item = tarfile.TarInfo(f"optodrive-support/{entry.name}")
            item.size, item.mode = len(content), 0o600
            archive.addfile(item, io.BytesIO(content))
    return buffer.getvalue()


def _run(read: Callable[[], str]) -> str:
    try:
        return read()
    except (OptodriveError, OSError, subprocess.SubprocessError) as error:
        return f"not available: {error}\n"


def _reader(path: Path) -> Callable[[], str]:
    return lambda: _read_file(path)


def _read_file(path: Path) -> str:
    return read_last_lines(path, ENTRY_MAX_BYTES).decode("utf-8", "replace")


def _find_config(source: str | None) -> Path:
    """Return the file of a configuration. Without one, return that of the service if it is installed."""
    if source is not None:
        return locate_shipped(f"{source}.toml") if source in list_shipped_configs() else Path(source)
    return CONFIG_PATH if os.path.lexists(CONFIG_PATH) else locate_shipped("display-437.toml")


def _list_named_files(config: "Config | None") -> Iterator[tuple[str, Path]]:
    if config is None:
        return
    for number, stage in enumerate(config.list_stage_configs()):
        named = {"field": stage.scanner.field, "mirrors": stage.scanner.mirrors}
        for kind, name in named.items():
            if name:
                yield f"{number}-{kind}.toml", Path(name)
    if config.display.pixel_map:
        yield "pixels.toml", Path(config.display.pixel_map)
    if config.display.sensitivity_map:
        yield "sensitivity.toml", Path(config.display.sensitivity_map)
    if config.pixel_model.parameters.endswith(".toml"):
        yield "model.toml", Path(config.pixel_model.parameters)


def _check_config(path: Path) -> str:
    from optodrive.planning.display_model import DisplayModel

    display = DisplayModel.from_config(load_config(path))
    return f"{display.config.name}: {len(display.layout)} pixels, configuration valid\n"


def _list_secrets(config: "Config | None") -> Iterator[str]:
    """Yield every token that this user can read."""
    secret = os.environ.get(ENVIRONMENT_VARIABLE)
    if secret:
        yield secret
    files = {SERVICE_TOKENS, *build_tokens_path(0).parent.glob("token-*")}
    files |= {
        Path(name) for name in (os.environ.get(FILE_ENVIRONMENT_VARIABLE), config and config.daemon.tokens) if name
    }
    for path in files:
        with suppress(OptodriveError):
            yield from (token.secret for token in read_tokens(path).all)


def _describe_versions() -> str:
    packages = sorted({f"{item.metadata['Name']} {item.version}" for item in distributions()}, key=str.lower)
    return "\n".join([f"Python {sys.version}", platform.platform(), f"{os.cpu_count()} processors", *packages]) + "\n"


def _describe_environment() -> str:
    return "".join(f"{name}={value}\n" for name, value in sorted(os.environ.items()) if name.startswith(VARIABLES))


def _read_journal() -> str:
    done = subprocess.run(JOURNAL, capture_output=True, timeout=JOURNAL_TIMEOUT_S)
    whole = done.stdout + done.stderr
    last = whole if len(whole) <= ENTRY_MAX_BYTES else whole[-ENTRY_MAX_BYTES:].partition(b"\n")[2]
    return last.decode("utf-8", "replace")


def _read_state(url: str) -> str:
    from optodrive.client.api_request import READ_STATE
    from optodrive.client.http import DaemonClient

    client = DaemonClient(url, timeout_s=DAEMON_TIMEOUT_S)
    return json.dumps(client.call(READ_STATE), indent=2) + "\n"
