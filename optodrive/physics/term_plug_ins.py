"""Checks of a term of another package before any computation calls its kernels."""

import re
from importlib import import_module
from math import isfinite

import numpy as np

from optodrive.core.kernels import compile_signature
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import AMBIENT_K, CONTEXT_SIZE, FIRST_FOLLOWER, Term

PLUG_INS = "optodrive.terms"
"""Group of the entry points by which other packages offer terms."""
HEAT_HOOKS = ("optical_power", "decaying_power", "heat_capacity", "bridge_resistance", "heat_loss", "wall_rise")
"""Hooks of `Kernels` by which a term can warm something."""
COLD, WARM = 0.0, 60.0
"""Rises of all states at which kernels are tried, K."""
TYPICAL = {
    "optical_power": 1.0,
    "heat_capacity": 1e-4,
    "bridge_resistance": 200.0,
    "wall_rise": 20.0,
    "membrane_drive": 60.0,
    "force_drive": 60.0,
    "displacement": 1e-4,
    "force": 0.1,
    "sensor_reading": 60.0,
    "sensor_lag": 1e-3,
}
"""Value without the term at which each hook is tried, SI; 0 for the others."""


def changes_heat(term: Term) -> bool:
    """Return whether a term acts on light or heat, so that a cap may depend on it."""
    return term.couples_neighbours or any(getattr(term.kernels, hook) is not None for hook in HEAT_HOOKS)


def check_term(name: str, kind: object) -> Term:
    """Return the term of a class of another package.

    Raises an exception that says what is wrong with it.
    """
    if not isinstance(kind, type) or not issubclass(kind, Term) or getattr(kind, "key", None) != name:
        raise TypeError(f"a class of Term with the entry point's name {name} as its key is expected")
    term = kind()
    if not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise ValueError("a key of small letters, digits and _ is expected")
    if not (kind.__doc__ and term.label and term.parameters):
        raise ValueError("a docstring with the equation, a label and parameters are expected")
    if term.states or not term.in_pixel:
        raise ValueError("a term with states has followers; only terms of optodrive have rows of the pixel")
    for item in term.parameters:
        _check_parameter(item)
    for hook, function in term.kernels._asdict().items():
        if function is not None:
            _check_kernel(term, hook, function)
    return term


def _check_parameter(item: object) -> None:
    if not isinstance(item, TermParameter):
        raise TypeError("parameters of TermParameter are expected")
    stated = (item.low, item.default, item.high, *item.starts)
    if not all(isfinite(value) and item.low <= value <= item.high for value in stated):
        raise ValueError(f"{item.name}: default and starts from low to high are expected")


def _check_kernel(term: Term, hook: str, function: object) -> None:
    """Compile a kernel, and try it in Python, which finds an index that is out of range, at the parameters' ends."""
    plain = getattr(function, "py_func", None)
    if plain is None:
        raise TypeError(f"{hook}: a function with the decorator optodrive.core.kernels.kernel is expected")
    if getattr(import_module(plain.__module__), plain.__name__, None) is not function:
        raise ValueError(f"{hook}: a kernel of its module, by its own name, is expected")
    compile_signature(function, returns=hook != "rates")
    states = FIRST_FOLLOWER + len(term.followers)
    context = np.full(CONTEXT_SIZE, 1.0)
    context[AMBIENT_K] = 293.15
    for rise_k in (COLD, WARM):
        for v in _list_values(term):
            y = np.full(states, rise_k)
            # `rates` adds to an array; each other hook returns a number.
            x: FloatArray | float = np.zeros(states) if hook == "rates" else TYPICAL.get(hook, 0.0)
            with np.errstate(all="ignore"):
                result = plain(v, y, FIRST_FOLLOWER, context.copy(), x)
            rates = x if isinstance(x, np.ndarray) else np.zeros(states)
            if not np.isfinite(rates if hook == "rates" else float(result)).all():
                raise ValueError(f"{hook}: no number at parameters {v.tolist()} and a rise of {rise_k:g} K")
            if rates[:FIRST_FOLLOWER].any() or (y != rise_k).any():
                raise ValueError(f"{hook}: rates of its own followers only are expected")


def _list_values(term: Term) -> list[FloatArray]:
    """List the parameters: all at their defaults, all low, all high, and each alone low and high."""
    rows = [[getattr(item, name) for item in term.parameters] for name in ("default", "low", "high")]
    alone = [[*rows[0][:k], end[k], *rows[0][k + 1 :]] for end in rows[1:] for k in range(len(rows[0]))]
    return [np.array(row, dtype=np.float64) for row in (*rows, *alone)]
