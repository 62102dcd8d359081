"""Numba kernels: plain Python functions on numbers and arrays, compiled on first use and cached on disk.

The cache key of a kernel is its bytecode together with everything that the bytecode refers to: called kernels, global
constants and the fields of the named tuples in its signature. A comment, a docstring or an edit elsewhere in the file
therefore does not invalidate machine code, and a changed callee or constant in another file does.

A kernel counts no references to its arguments unless it creates arrays: numba would count each array at each call of a
small kernel, atomically, which takes longer than what the kernel computes.
"""

import ctypes
import mmap
import os
import re
import sys
from collections.abc import Callable, Iterable
from functools import cached_property
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, ParamSpec, TypeVar

import numpy as np

from optodrive.core.extras import hide_modules

with hide_modules("scipy", "yaml"):  # numba asks for a version, and reads a file of settings that nobody has
    import numba
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.runtime.nrt import rtsys

P = ParamSpec("P")
T = TypeVar("T")


def _cache_dir() -> Path:
    return Path(
        os.environ.get("NUMBA_CACHE_DIR")
        or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "optodrive", "kernels")
    )


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


CACHE_VERSION = "5"
"""Changes with what cached machine code refers to and with the compiler's options.

1 named generated modules by their content; 2 counted references in every kernel; 3 did not tell those that do so apart;
4 held an entry for callers in C, which took a sixth of the compilation.
"""
_FOLDER = _cache_dir()
CACHED = _is_writable(_FOLDER)
"""False where the cache folder is not writable: every process then compiles its kernels anew."""


def code_folder() -> Path | None:
    """Return the folder for generated source files and machine code, or None where it is not writable."""
    return _FOLDER if CACHED else None


def code_stamp(function: FunctionType) -> str:
    """Return the digest of a function's bytecode and of everything that the bytecode refers to, as hexadecimal."""
    parts: list[str] = [CACHE_VERSION]
    _collect_function(function, parts, set())
    return sha256("\n".join(parts).encode()).hexdigest()


def _collect_function(function: FunctionType, parts: list[str], visited: set[int]) -> None:
    if id(function) in visited:
        return
    visited.add(id(function))
    names: list[str] = []
    _collect_code(function.__code__, function.__doc__, parts, names)
    parts.append(repr((function.__defaults__, function.__kwdefaults__)))
    referenced = [function.__globals__[name] for name in dict.fromkeys(names) if name in function.__globals__]
    for value in [*referenced, *function.__annotations__.values(), *(cell.cell_contents for cell in _cells(function))]:
        _collect_value(value, names, parts, visited)


def _cells(function: FunctionType) -> Iterable[Any]:
    return function.__closure__ or ()


def _collect_code(code: CodeType, docstring: str | None, parts: list[str], names: list[str]) -> None:
    parts += [code.co_name, code.co_code.hex(), repr((code.co_names, code.co_varnames, code.co_argcount))]
    names += code.co_names
    for position, constant in enumerate(code.co_consts):
        if isinstance(constant, CodeType):
            _collect_code(constant, None, parts, names)
        # The docstring is the first constant: editing it changes no machine code.
        elif position > 0 or constant != docstring:
            parts.append(repr(constant))


def _collect_value(value: Any, names: list[str], parts: list[str], visited: set[int]) -> None:
    callee = getattr(value, "py_func", value)
    if isinstance(callee, FunctionType):
        parts.append(repr(getattr(value, "targetoptions", None)))
        _collect_function(callee, parts, visited)
    elif isinstance(value, np.ndarray):
        parts.append(f"{value.dtype} {value.shape} {sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}")
    elif isinstance(value, ModuleType):
        parts.append(value.__name__)
        if value.__name__.split(".")[0] == __name__.split(".")[0]:
            # Of a module of this package only the names that the bytecode mentions: the rest may change.
            for name in sorted(set(names) & set(vars(value))):
                _collect_value(vars(value)[name], names, parts, visited)
    elif isinstance(value, type) and hasattr(value, "_fields"):
        if id(value) not in visited:
            visited.add(id(value))
            # The index of cached code names the class by its module, and cannot be read when that has moved.
            parts.append(f"{value.__module__} {value.__qualname__} {value._fields}")
            for annotation in value.__annotations__.values():
                _collect_value(annotation, names, parts, visited)
    elif isinstance(value, tuple):
        for item in value:
            _collect_value(item, names, parts, visited)
    else:
        parts.append(getattr(value, "__qualname__", None) or repr(value))


COMPILER_LIBRARY = "/libllvmlite.so"
MAPPING = re.compile(r"([0-9a-f]+)-([0-9a-f]+) ")
ARRAY_FUNCTIONS = "numba.np.arraymath"


def _import_array_functions() -> None:
    """Import numba's array functions without SciPy, of which they use linear algebra that no kernel calls.

    SciPy is optional here, and its import takes longer than that of all kernels.
    """
    if ARRAY_FUNCTIONS in sys.modules:
        return
    linear_algebra: Any = import_module("numba.np.linalg")
    original = linear_algebra.ensure_blas
    linear_algebra.ensure_blas = _refuse_blas
    try:
        import_module(ARRAY_FUNCTIONS)
    finally:
        linear_algebra.ensure_blas = original


def _refuse_blas() -> None:
    raise ImportError("no kernel calls linear algebra")


class _KernelLocator:
    """Places the machine code of every kernel in one folder. The stamp in `_KernelCache` tells its versions apart."""

    def __init__(self, function: FunctionType) -> None:
        self._module = function.__module__

    def ensure_cache_path(self) -> None:
        _FOLDER.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(_FOLDER)

    def get_source_stamp(self) -> str:
        return ""

    def get_disambiguator(self) -> str:
        return self._module

    @classmethod
    def from_function(cls, py_func: FunctionType, py_file: str) -> "_KernelLocator":
        return cls(py_func)


class _KernelCacheImpl(CompileResultCacheImpl):
    _locator_classes: Any = (_KernelLocator,)


_open_index: Callable[[str, str, str], Any] = IndexDataCacheFile  # numba has no types
_initialize_runtime: Callable[[Any], None] = rtsys.initialize


class _KernelCache(FunctionCache):
    """Numba's cache of one function, keyed on `code_stamp`.

    The stamp is computed at the first look-up: a kernel may call one that its module defines later.
    """

    _impl_class = _KernelCacheImpl
    counts_references = False

    @cached_property
    def file_base(self) -> str:
        """Name of the kernel's cache files without their suffixes."""
        kind = "array" if self.counts_references else "plain"
        return f"{self._impl.filename_base}-{kind}-{code_stamp(self._py_func)[:24]}"

    def is_empty(self) -> bool:
        """Return whether no machine code of the kernel is cached."""
        return not Path(self.cache_path, f"{self.file_base}.nbi").exists()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the cached machine code for a signature, None if there is none.

        Numba would first load all that it can compile, a fifth of the time of `optodrive plan`. Machine code needs
        only numba's run time, which unpacks arrays, and the modules of what it inlined. The compiler loads the rest
        itself.
        """
        _import_array_functions()
        _initialize_runtime(target_context)
        return self._load_overload(sig, target_context)

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        self._open()
        return super()._load_overload(sig, target_context)  # type: ignore[no-untyped-call]

    def _save_overload(self, sig: Any, data: Any) -> None:
        self._open()
        super()._save_overload(sig, data)  # type: ignore[no-untyped-call]

    def _open(self) -> None:
        self._cache_file: Any = _open_index(self.cache_path, self.file_base, self.file_base)


_new_cache: Callable[[Any], _KernelCache] = _KernelCache  # numba has no types


def is_cached(function: Callable[..., Any]) -> bool:
    """Return whether machine code of a kernel is cached, so that its first use compiles nothing."""
    cache: Any = getattr(function, "_cache", None)
    return isinstance(cache, _KernelCache) and not cache.is_empty()


COMPILATION = "numba:compile"
"""Name of numba's event."""


class _CompilationListener(event.Listener):
    """Counts the compilations of a process and reports when one begins and when none is left in progress."""

    def __init__(self, on_begin: Callable[[int], None], on_end: Callable[[], None]) -> None:
        self._on_begin, self._on_end = on_begin, on_end
        self._count = self._depth = 0
        self._process = os.getpid()

    def on_start(self, data: Any) -> None:
        if os.getpid() == self._process:  # a fork has no terminal of its own
            self._depth += 1
            self._count += 1
            self._on_begin(self._count)

    def on_end(self, data: Any) -> None:
        if os.getpid() == self._process:
            self._depth -= 1
            if self._depth == 0:
                self._on_end()


_listeners: list[_CompilationListener] = []


def observe_compilation(on_begin: Callable[[int], None], on_end: Callable[[], None]) -> None:
    """Call `on_begin` with the count so far when this process compiles a kernel, and `on_end` when it has done so.

    A kernel whose machine code is cached is loaded, not compiled. A later observer replaces an earlier one.
    """
    change: Any = event  # numba has no types
    while _listeners:
        change.unregister(COMPILATION, _listeners.pop())
    _listeners.append(_CompilationListener(on_begin, on_end))
    change.register(COMPILATION, _listeners[0])


def kernel(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a function that creates no array on its first use and cache the machine code on disk.

    Views of its arguments are no new arrays. Without reference counts, small kernels are several times as fast, and the
    compiler refuses to create or return an array.
    """
    return _cache(compile_here(function, counts_references=False), function, counts_references=False)


def array_kernel(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a function that creates arrays on its first use and cache the machine code on disk."""
    return _cache(compile_here(function, counts_references=True), function, counts_references=True)


def compile_signature(function: Any, returns: bool) -> None:
    """Compile a kernel of a term before its first use.

    returns: whether its last argument is the number that it returns changed, in place of an array that it writes to
    """
    array = numba.float64[::1]
    function.compile((array, array, numba.int64, array, numba.float64 if returns else array))


_njit: Any = numba.njit  # numba's types lack _nrt


def compile_here(function: Callable[P, T], counts_references: bool) -> Callable[P, T]:
    """Compile a function on its first use, for this process only: one that was made at run time has no lasting name."""
    # No kernel is passed as a value or called from C: an entry for that would be compiled with all that it inlines.
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": counts_references}
    compiled: Callable[P, T] = _njit(**options)(function)
    return compiled


def _cache(compiled: Any, function: Callable[P, T], counts_references: bool) -> Callable[P, T]:
    if CACHED:
        compiled._cache = _new_cache(function)
        compiled._cache.counts_references = counts_references
    result: Callable[P, T] = compiled
    return result


def release_compiler() -> None:
    """Give up the pages of LLVM's library, 65 MiB: only compiling and loading kernels needs them, not calling them.

    A page that is needed later is read from the file again.
    """
    madvise = ctypes.CDLL(None).madvise
    madvise.argtypes = (ctypes.c_size_t, ctypes.c_size_t, ctypes.c_int)
    begin = end = 0
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8", errors="replace").splitlines():
        if mapping := MAPPING.match(line):
            begin, end = (int(text, 16) for text in mapping.groups()) if line.endswith(COMPILER_LIBRARY) else (0, 0)
        elif line.split() == ["Anonymous:", "0", "kB"] and end:  # no page differs from the file
            madvise(begin, end - begin, mmap.MADV_DONTNEED)
