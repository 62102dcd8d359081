"""All terms' kernels, one chain a hook, as a module that numba can compile and keep.

A chain calls, in order of their keys, the kernels of those terms that are on. It is written out as source because
numba keeps machine code only of functions that stand in a file.
"""

import sys
from collections.abc import Callable
from hashlib import sha256
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

from optodrive.core.files import written_whole
from optodrive.core.kernels import code_folder
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.physics.term import OWN, Kernels, Term
from optodrive.physics.terms import known_terms

VALUES = 4
"""Room for so many parameters a term."""

Chain = Callable[[IntArray, FloatArray, FloatArray, FloatArray, float], float]
Moving = Callable[[IntArray, FloatArray, FloatArray, FloatArray, FloatArray], None]


class Chains(NamedTuple):
    """One function a hook: (on, v, y, c, x), on [terms], v [terms, VALUES]; x passes through the terms that are on."""

    light: Chain
    capacity: Chain
    bridge: Chain
    leaving: Chain
    wall: Chain
    rates: Moving
    lifts: Chain
    pushes: Chain
    reads: Chain
    lag: Chain


TERMS: tuple[Term, ...] = tuple(known_terms()[key] for key in sorted(known_terms()))
"""Every term, in the order of `on` and `v`."""
ROW = {term.key: row for row, term in enumerate(TERMS)}
STATES = OWN + sum(len(term.followers) for term in TERMS)
OWN_ROW = tuple(OWN + sum(len(term.followers) for term in TERMS[:row]) for row in range(len(TERMS)))
"""Row of each term's first follower."""


def _source() -> str:
    lines = ["from optodrive.core.kernels import kernel"]
    calls: dict[str, list[str]] = {hook: [] for hook in Kernels._fields}
    for row, term in enumerate(TERMS):
        for hook in Kernels._fields:
            function = getattr(term.kernels, hook)
            if function is None:
                continue
            name = f"{term.key}_{hook}"
            lines.append(f"from {function.__module__} import {function.__name__} as {name}")
            target = "" if hook == "rates" else "x = "
            calls[hook] += [f"    if on[{row}]:", f"        {target}{name}(v[{row}], y, {OWN_ROW[row]}, c, x)"]
    for hook, body in calls.items():
        lines += ["", "", "@kernel", f"def {hook}(on, v, y, c, x):", *body, "    return x"]
    return "\n".join(lines) + "\n"


def _composed() -> Any:
    source = _source()
    name = f"optodrive_chains_{sha256(source.encode()).hexdigest()[:16]}"
    folder = code_folder() or Path(mkdtemp())
    path = folder / f"{name}.py"
    if not path.exists():
        with written_whole(path) as temporary:
            temporary.write_text(source)
    spec = spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be loaded")
    module = module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


_MODULE = _composed()
CHAINS = Chains(*(getattr(_MODULE, hook) for hook in Chains._fields))
