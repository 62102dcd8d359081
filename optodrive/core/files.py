"""Atomic writing of files, and reading of regular files of bounded size."""

import fcntl
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from optodrive.core.errors import InputError, Unquoted, refuse_os_error

REQUEST_BYTES_MAX = 64_000_000
"""Largest file of frames or of a picture, bytes: that of a daemon's largest request body."""


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary file beside `path` that replaces it if the block succeeds and is removed if it fails.

    Raises InputError with the path if it cannot be written.
    """
    temporary: Path | None = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a file that can be written") from None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, in UTF-8. Raise InputError with the path if it cannot be written."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_private_text(path: Path, text: str) -> None:
    """Write a text file of mode 0600 atomically, in UTF-8.

    Raises OSError if it cannot be written; the file that was there before is then unchanged.
    """
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")  # mode 0600
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(name).replace(path)
    finally:
        Path(name).unlink(missing_ok=True)


def check_output(option: str, path: Path | None, *suffixes: str, folder: bool = False, may_exist: bool = False) -> None:
    """Raise InputError unless a new output can be written at this path, before anything is computed for it.

    suffixes: those that a file may have, lower case; none: any. folder: a folder may be written instead, or only a
    folder where no suffixes are given; a name with the suffix of a file is none. may_exist: a folder may hold files,
    those of an interrupted run that goes on. No other output replaces what is there.
    """
    if path is None:
        return
    suffix = path.suffix.lower()
    names_file = suffix in suffixes or not (suffixes or folder)
    names_folder = folder and (not suffixes or path.is_dir() or not suffix[1:2].isalpha())
    if not (names_file or names_folder):
        expected = "a name that ends in " + " or ".join(suffixes)
        raise InputError(option, str(path), expected + (", or the name of a new folder" if folder else ""))
    if names_file and path.is_dir():
        raise InputError(option, str(path), "a file; this is a folder")
    if names_folder and not names_file and path.exists() and not path.is_dir():
        raise InputError(option, str(path), "a folder; this is a file")
    parent = path.absolute().parent
    if names_folder and not names_file and not suffixes:  # created with its parents
        parent = next(item for item in (path.absolute(), *path.absolute().parents) if item.exists())
    if not parent.is_dir():
        raise InputError(option, str(path), f"a path in a folder; {parent} is none")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(option, str(path), f"a path in a folder that can be written; {parent} cannot")
    if not may_exist:
        _require_new(option, path)


def _require_new(option: str, path: Path) -> None:
    if path.is_dir():
        with os.scandir(path) as entries:
            if any(entries):
                raise InputError(option, str(path), "a new or empty folder")
    elif os.path.lexists(path):
        raise InputError(option, str(path), "a new file; this one exists")


def create_folder(path: Path) -> None:
    """Create a folder and its parents unless it exists. Raise InputError with the path if it cannot be created."""
    with refuse_os_error(path, "a folder that can be created"):
        path.mkdir(parents=True, exist_ok=True)


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Let one process at a time change the files of a folder. Raise InputError for one that cannot be opened."""
    with refuse_os_error(folder, "an existing folder"):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def read_regular_file(path: Path, bytes_max: int, *, private: bool = False) -> bytes:
    """Return the content of a regular file of bounded size. Never open a device, never wait for a pipe.

    private: require that only the file's owner can read it. Raise InputError for any other file.
    """
    with _open_regular_file(path, private) as file:
        content = file.read(bytes_max + 1)
    if len(content) > bytes_max:
        raise InputError(str(path), Unquoted("a larger file"), f"at most {bytes_max} bytes")
    return content


def read_bounded(path: Path, bytes_max: int = REQUEST_BYTES_MAX) -> bytes:
    """Return the content of a file of bounded size, for which a caller may wait: a pipe, too. Raise InputError."""
    with refuse_os_error(path, "a readable file"), path.open("rb") as file:
        content = file.read(bytes_max + 1)
    if len(content) > bytes_max:
        raise InputError(str(path), Unquoted("a larger file"), f"at most {bytes_max} bytes")
    return content


def read_last_lines(path: Path, bytes_max: int) -> bytes:
    """Return whole lines from the end of a regular file, at most `bytes_max` bytes. Raise InputError for another."""
    with _open_regular_file(path) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - bytes_max))
        content = file.read(bytes_max)
    return content if size <= bytes_max else content.partition(b"\n")[2]


@contextmanager
def _open_regular_file(path: Path, private: bool = False) -> Iterator[BinaryIO]:
    try:
        _require_regular(path, path.stat().st_mode)  # to open a serial port may reset a board
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        try:
            mode = os.fstat(descriptor).st_mode  # of what was opened: another file may have the name by now
            _require_regular(path, mode)
            if private and mode & 0o077:
                expected = f"0600, for it holds secrets: chmod 600 {path}"
                raise InputError(str(path), f"mode {stat.S_IMODE(mode):04o}", expected)
            with os.fdopen(descriptor, "rb", closefd=False) as file:
                yield file
        finally:
            os.close(descriptor)
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
    except ValueError as error:  # a null character in the path
        raise InputError(str(path), Unquoted(str(error)), "the path of a file") from None


def _require_regular(path: Path, mode: int) -> None:
    if stat.S_ISREG(mode):
        return
    kinds = {stat.S_ISDIR: "a folder", stat.S_ISFIFO: "a pipe", stat.S_ISSOCK: "a socket"}
    kind = next((name for is_kind, name in kinds.items() if is_kind(mode)), "a device")
    raise InputError(str(path), Unquoted(kind), "a regular file")
