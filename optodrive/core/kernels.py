"""Kernels: plain Python functions on numbers and arrays, compiled by numba on first use and kept in its cache."""

import os
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import ParamSpec, TypeVar

import numba

P = ParamSpec("P")
T = TypeVar("T")


def _cache_dir() -> Path:
    """Where machine code is kept: apart for each state of the sources.

    Numba looks only at the file of the kernel itself; one that calls a kernel of another file would stay as it was
    when that file changes.
    """
    package = Path(__file__).parents[1]
    digest = sha256()
    for source in sorted(
        [*package.glob("physics/**/*.py"), *package.glob("planning/**/*.py"), *package.glob("device/*.py")]
    ):
        digest.update(source.read_bytes())
    base = os.environ.get("NUMBA_CACHE_DIR") or Path(
        os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "optodrive", "kernels"
    )
    return Path(base, digest.hexdigest()[:16])


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


_FOLDER = _cache_dir()
CACHED = _writable(_FOLDER)
"""Without a folder to keep it in, machine code is made anew by every process."""
numba.config.CACHE_DIR = str(_FOLDER)  # type: ignore[attr-defined]


def code_folder() -> Path | None:
    """Where generated code may be kept beside its machine code, for this state of the sources."""
    return _FOLDER if CACHED else None


def cold() -> bool:
    """Whether no machine code is kept yet for this state of the sources: the next use of kernels takes seconds."""
    return not CACHED or not any(_FOLDER.glob("*/*.nbi"))


def kernel(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a function on its first use; the machine code is kept, so only the first run after a change pays."""
    compiled: Callable[P, T] = numba.njit(cache=CACHED, nogil=True, error_model="numpy")(function)
    return compiled


def vector_kernel(function: Callable[P, T]) -> Callable[P, T]:
    """As `kernel`, and sums may be taken in any order: only so does the processor add several terms at once.

    The last digits of a result then depend on the processor.
    """
    free = {"reassoc", "contract", "arcp"}
    compiled: Callable[P, T] = numba.njit(cache=CACHED, nogil=True, error_model="numpy", fastmath=free)(function)
    return compiled
