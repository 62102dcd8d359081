"""Atomic writing of files, and reading of TOML with one-line errors."""

import os
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from optodrive.core.errors import InputError


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


def check_output(option: str, path: Path | None, *suffixes: str, folder: bool = False) -> None:
    """Raise InputError unless an output can be written at this path, before anything is computed for it.

    suffixes: those that a file may have, lower case; none: any. folder: a folder may be written instead, or only a
    folder where no suffixes are given; a name with the suffix of a file is none.
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


def create_folder(path: Path) -> None:
    """Create a folder and its parents unless it exists. Raise InputError with the path if it cannot be created."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a folder that can be created") from None


def read_toml(path: Path) -> dict[str, Any]:
    """Return a TOML file as a table. Raise InputError if it cannot be read or parsed."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(str(path), str(error), "valid TOML") from None
