"""The folder of a running daemon's sockets, which only its user can open, and where commands find it."""

import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from optodrive.core.errors import InputError, refuse_os_error
from optodrive.core.files import lock_folder

SOCKET_PATH_MAX_BYTES = 100
"""Longest path of a socket; the kernel allows 107."""
FOLDER_PREFIX = "optodrive-"
"""Start of the name of a folder in the folder for temporary files."""
LOOKUP_PREFIX = "daemon-"
"""Start of the name under which commands find it; the TCP port follows."""
FOLDER_FLAGS = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
LINK_MODE, SHARED_LINK_MODE = 0o600, 0o660


@dataclass(frozen=True)
class RuntimeFolder:
    """The sockets of the daemon's processes.

    path: the folder, of mode 0700; link_socket: beside the configured Unix socket if there is one, so that its group
    reaches it; lookup_path: where commands look for the folder, a link where a socket's path would be too long
    lock: descriptor whose lock marks the folder as in use, which every forked process inherits
    """

    path: Path
    link_socket: Path
    link_socket_mode: int
    lookup_path: Path
    lock: int | None = None

    @property
    def planner_socket(self) -> Path:
        """Socket of the planner process."""
        return self.path / "planner.sock"

    @property
    def preview_socket(self) -> Path:
        """Socket of the preview process."""
        return self.path / "preview.sock"

    @property
    def acceptor_socket(self) -> Path:
        """Socket of the acceptor process."""
        return self.path / "acceptor.sock"

    @property
    def link_settings(self) -> Path:
        """File of the link process's settings."""
        return self.path / "link.json"

    def remove(self) -> None:
        """Remove the folder and the link socket."""
        for path in {self.link_socket, self.lookup_path} - {self.path}:
            with suppress(OSError):
                path.unlink()
        shutil.rmtree(self.path, ignore_errors=True)
        if self.lock is not None:
            os.close(self.lock)


def find_link_socket(port: int | None, unix: Path | None) -> Path:
    """Return the socket of the link process of a daemon, by its TCP port or its Unix socket."""
    if unix is not None:
        return unix.with_name(f"{unix.stem}-link.sock")
    return Path(os.path.realpath(_build_lookup_path(port or 0))) / "link.sock"


def open_runtime_folder(port: int, unix: Path | None) -> RuntimeFolder:
    """Create the runtime folder of the daemon on a TCP port, and remove those that killed daemons left.

    unix: the configured Unix socket. InputError if the folder cannot be created.
    """
    lookup_path = _build_lookup_path(port)
    if unix is not None and len(os.fsencode(find_link_socket(None, unix))) > SOCKET_PATH_MAX_BYTES:
        raise InputError("daemon.socket", str(unix), "a shorter path, because the link's socket lies beside it")
    with refuse_os_error(lookup_path, "a folder that can be created"):
        lookup_path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with lock_folder(lookup_path.parent):  # no other daemon is between creation and lock of its own folder
            path, lock = _create_folder(lookup_path)
            _remove_unused(lookup_path)
        if unix is not None:  # a command that knows only the TCP port finds it here
            (path / "link.sock").symlink_to(find_link_socket(None, unix.absolute()))
    if unix is None:
        return RuntimeFolder(path, path / "link.sock", LINK_MODE, lookup_path, lock)
    return RuntimeFolder(path, find_link_socket(None, unix), SHARED_LINK_MODE, lookup_path, lock)


def _create_folder(lookup_path: Path) -> tuple[Path, int]:
    """Create the folder, or one where a socket fits and a link to it. Return its path and its lock."""
    _remove_left_behind(lookup_path)
    if len(os.fsencode(lookup_path / "acceptor.sock")) <= SOCKET_PATH_MAX_BYTES:
        lookup_path.mkdir(mode=0o700)
        path = lookup_path
    else:  # a socket does not fit there
        path = Path(tempfile.mkdtemp(prefix=FOLDER_PREFIX))
        lookup_path.symlink_to(path)
    lock = os.open(path, FOLDER_FLAGS)
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return path, lock


def _remove_unused(own: Path) -> None:
    """Remove the folders, and the tokens, of daemons on other ports of which no process is left."""
    for lookup_path in set(own.parent.glob(f"{LOOKUP_PREFIX}[0-9]*")) - {own}:
        try:
            lock = os.open(lookup_path, FOLDER_FLAGS)
        except OSError:  # a link to nothing
            _remove_left_behind(lookup_path)
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue
        finally:
            os.close(lock)
        _remove_left_behind(lookup_path)
        lookup_path.with_name(f"token-{lookup_path.name.removeprefix(LOOKUP_PREFIX)}").unlink(missing_ok=True)


def _build_lookup_path(port: int) -> Path:
    runtime = os.environ.get("XDG_RUNTIME_DIR") or Path.home() / ".cache"
    return Path(runtime) / "optodrive" / f"{LOOKUP_PREFIX}{port}"


def _remove_left_behind(lookup_path: Path) -> None:
    """Remove the folder of a killed daemon: of one on the caller's own TCP port, or of one whose lock is free."""
    if lookup_path.is_symlink():
        target = lookup_path.readlink()
        if target.name.startswith(FOLDER_PREFIX):
            shutil.rmtree(target, ignore_errors=True)
        lookup_path.unlink()
    elif lookup_path.exists():
        shutil.rmtree(lookup_path)
