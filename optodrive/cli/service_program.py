"""The program that the systemd unit starts, and whether the unit's sandbox hides a part of it."""

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

from optodrive.core.errors import InputError, RefusedError

HIDDEN_FOLDERS = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108 - folders that the unit cannot access
PROBE = (
    "import json, sys; from importlib.util import find_spec; spec = find_spec('optodrive'); "
    "print(json.dumps([sys.base_prefix, [spec.origin] if spec else [], sys.path]))"
)
PROBE_TIMEOUT_S = 20.0
LINKS_MAX = 40


def check_program(program: Path) -> None:
    """Raise InputError for a path that the unit cannot contain, and RefusedError for a program that it cannot access.

    A program that exists on this machine is followed through its symbolic links to its interpreter, the interpreter's
    base and the package.
    """
    if not program.is_absolute() or any(c.isspace() or c in "%$\"'\\" for c in str(program)):
        raise InputError("--program", str(program), "an absolute path of plain characters")
    for place, role in _list_places(program):
        for folder in HIDDEN_FOLDERS:
            if place.is_relative_to(folder) or place.is_relative_to(os.path.realpath(folder)):
                raise RefusedError(
                    f"the service has no access to {folder}, the folder of {place}{role}; install optodrive where all "
                    "may read it, with a Python that all may read (/usr/bin/python3 -m venv /opt/optodrive), and run "
                    "its `optodrive service install`, or name it with --program"
                )


def _list_places(program: Path) -> Iterator[tuple[Path, str]]:
    """Yield every path that the start of a program touches, with its role in it."""
    for place in _follow_links(program):
        yield place, "" if place == program else f", to which {program} leads"
    interpreter = _read_interpreter(program)
    if interpreter is None:
        return
    for place in _follow_links(interpreter):
        yield place, f", the interpreter of {program}"
    home = _read_home(interpreter)
    if home is not None:
        for place in _follow_links(home):
            yield place, f", the base of the virtual environment of {program}"
    base_prefix, package, search_path = _probe(interpreter)
    for place in base_prefix:
        yield place, f", the base of the virtual environment of {program}"
    for place in (*package, *search_path):
        yield place, f", from which {program} imports"


def _follow_links(path: Path) -> Iterator[Path]:
    """Yield a path, each symbolic link that it leads through, and its end."""
    yield path
    for _ in range(LINKS_MAX):
        try:
            if not path.is_symlink():
                break
            path = path.parent / path.readlink()
        except OSError:
            break
        yield path
    yield Path(os.path.realpath(path))


def _read_interpreter(program: Path) -> Path | None:
    """Return the interpreter that a script names in its first line, or None for a program of another kind."""
    try:
        with program.open("rb") as file:
            line = file.readline(4096)
    except OSError:
        return None
    words = line[2:].split() if line.startswith(b"#!") else []
    return Path(words[0].decode(errors="replace")) if words else None


def _read_home(interpreter: Path) -> Path | None:
    """Return the folder of the base interpreter of a virtual environment, or None without one."""
    try:
        lines = (interpreter.parent.parent / "pyvenv.cfg").read_text("utf-8", "replace").splitlines()
    except OSError:
        return None
    pairs = [line.partition("=") for line in lines]
    return next((Path(value.strip()) for key, _, value in pairs if key.strip() == "home"), None)


def _probe(interpreter: Path) -> tuple[list[Path], list[Path], list[Path]]:
    """Ask an interpreter for its base, the package and its search path. Return empty lists if it does not answer."""
    if "python" not in interpreter.name:
        return [], [], []
    try:
        done = subprocess.run(
            [interpreter, "-I", "-c", PROBE], capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, check=True
        )
        base_prefix, package, search_path = json.loads(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return [], [], []
    existing = [Path(place) for place in search_path if place and Path(place).exists()]
    return [Path(base_prefix)], [Path(place) for place in package], existing
