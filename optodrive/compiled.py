"""Kernels: plain Python functions on numbers and arrays, compiled by numba on first use and kept in its cache."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numba

P = ParamSpec("P")
T = TypeVar("T")


def kernel(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a function; the machine code is cached on disk, so only the first run after a change pays for it."""
    compiled: Callable[P, T] = numba.njit(cache=True, error_model="numpy")(function)
    return compiled
