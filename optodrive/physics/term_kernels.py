"""Chains of all terms' kernels, one function per hook, in a generated module.

A chain calls the kernels of the active terms in the order of their keys. The module is written to a source file because
numba caches machine code only of functions that a file defines.
"""

import sys
from collections.abc import Callable
from hashlib import sha256
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

from optodrive.core.files import atomic_write
from optodrive.core.kernels import code_folder
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.physics.term import FIRST_FOLLOWER, Kernels, Term
from optodrive.physics.terms import all_terms

HookChain = Callable[[IntArray, FloatArray, FloatArray, FloatArray, float], float]
RateChain = Callable[[IntArray, FloatArray, FloatArray, FloatArray, FloatArray], None]


class HookChains(NamedTuple):
    """One function per hook of `Kernels`, called as (on, v, y, c, x).

    on: [terms], 1 for an active term; v: [terms, MAX_PARAMETERS]; y: states; c: context. x passes through the kernels
    of the active terms.
    """

    optical_power: HookChain
    decaying_power: HookChain
    heat_capacity: HookChain
    bridge_resistance: HookChain
    heat_loss: HookChain
    wall_rise: HookChain
    rates: RateChain
    membrane_drive: HookChain
    force_drive: HookChain
    displacement: HookChain
    force: HookChain
    sensor_reading: HookChain
    sensor_lag: HookChain


TERMS: tuple[Term, ...] = tuple(all_terms()[key] for key in sorted(all_terms()))
"""Every term, in the order of the rows of `on` and `v`."""
MAX_PARAMETERS = max(term.row_length for term in TERMS)
TERM_ROW = {term.key: row for row, term in enumerate(TERMS)}
STATE_COUNT = FIRST_FOLLOWER + sum(len(term.followers) for term in TERMS)
FOLLOWER_ROW = tuple(FIRST_FOLLOWER + sum(len(term.followers) for term in TERMS[:row]) for row in range(len(TERMS)))
"""Row of each term's first follower in the state vector."""
MODULE_NAME = "optodrive_chains"
"""Name of the generated module, the same for every set of terms.

Cached machine code of the callers refers to the module by name, and outlives a change of the terms that leaves the
called chain as it is.
"""


def _generate_source() -> str:
    lines = ["from optodrive.core.kernels import kernel"]
    calls: dict[str, list[str]] = {hook: [] for hook in Kernels._fields}
    for row, term in enumerate(TERMS):
        for hook in Kernels._fields:
            function = getattr(term.kernels, hook)
            if function is None:
                continue
            name = f"{term.key}_{hook}"
            lines.append(f"from {function.__module__} import {function.__name__} as {name}")
            # `rates` writes into the array that it gets; all others return a value.
            target = "" if hook == "rates" else "x = "
            calls[hook] += [f"    if on[{row}]:", f"        {target}{name}(v[{row}], y, {FOLLOWER_ROW[row]}, c, x)"]
    for hook, body in calls.items():
        lines += ["", "", "@kernel", f"def {hook}(on, v, y, c, x):", *body, "    return x"]
    return "\n".join(lines) + "\n"


def _load_generated_module() -> Any:
    source = _generate_source()
    folder = code_folder() or Path(mkdtemp())
    # By content: processes of two checkouts share the cache folder.
    path = folder / f"{MODULE_NAME}_{sha256(source.encode()).hexdigest()[:16]}.py"
    if not path.exists():
        # Several processes may start at once; each sees a whole file or none.
        with atomic_write(path) as temporary:
            temporary.write_text(source)
    spec = spec_from_file_location(MODULE_NAME, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be loaded")
    module = module_from_spec(spec)
    # Before it is executed: cached machine code names the module, and its import must find this one.
    sys.modules[MODULE_NAME] = module
    spec.loader.exec_module(module)
    return module


_MODULE = _load_generated_module()
CHAINS = HookChains(*(getattr(_MODULE, hook) for hook in HookChains._fields))
