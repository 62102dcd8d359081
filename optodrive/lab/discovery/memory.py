"""Memories: one inner state by which a term depends on the past of a variable.

Theory of operation. Each is carried over a step in closed form, exact for a variable z that is linear in time between.
A lag follows z with a time constant. Presliding friction depends on the way of z alone, not on time: it tends to the
sign of the motion over a distance, exponentially (Dahl), or linearly with an end (an elastic element that slips, after
Maxwell; Bouc–Wen lies between). A delay is z itself at an earlier time.
"""

from math import exp, expm1

import numpy as np

from optodrive.core.kernels import array_kernel, kernel
from optodrive.core.types.arrays import FloatArray

NONE, LAG, FOLLOWER, DAHL, SLIP, DELAY = range(6)
PATH = (DAHL, SLIP)
"""Memories whose scale is a distance of the variable, not a time."""
FILTERS = (LAG, FOLLOWER, DELAY)
"""Memories that are linear filters of their variable: records of inputs and outputs hardly tell where one stands."""
TEXTS = {
    LAG: "m, m' = ({z} - m) / {s}",
    FOLLOWER: "(m - {z}), m' = ({z} - m) / {s}",
    DAHL: "h, h' = ({z}' - |{z}'| h) / {s}",
    SLIP: "h, h' = {z}' / {s} within -1 and 1",
    DELAY: "({z}(t - {s}) - {z})",
}


def name_memory(kind: int, is_output: bool, is_state: bool) -> str:
    """Return the class of a term with memory.

    What follows a state and acts on its equation is a second node beside it.
    """
    if kind in PATH:
        return "hysteresis"
    if kind == DELAY:
        return "delay"
    if is_output:
        return "creep" if kind == LAG else "lag"
    return "second node" if is_state else "lag"


@kernel
def carry(kind: int, before: float, z0: float, z: float, dt: float, scale: float) -> float:
    """Return a memory after dt in which its variable went from z0 to z."""
    if kind == DAHL:
        sign = 1.0 if z > z0 else -1.0
        return float(sign + (before - sign) * exp(-abs(z - z0) / scale))
    if kind == SLIP:
        return min(max(before + (z - z0) / scale, -1.0), 1.0)
    share = -expm1(-dt / scale) * scale / dt if dt > 0.0 else 1.0
    return float(z - (z - z0) * share + (before - z0) * exp(-dt / scale))


@kernel
def start_memory(kind: int, z: float) -> float:
    """Return a memory at the start of a record, as after a long rest at z."""
    return 0.0 if kind in (DAHL, SLIP) else z


@kernel
def take_value(kind: int, memory: float, z: float) -> float:
    """Return the argument of a term."""
    return memory - z if kind in (FOLLOWER, DELAY) else memory


@array_kernel
def _carry_along(kind: int, scale: float, t_s: FloatArray, z: FloatArray) -> FloatArray:
    out = np.zeros(len(z))
    memory = start_memory(kind, z[0])
    out[0] = take_value(kind, memory, z[0])
    for k in range(1, len(z)):
        memory = carry(kind, memory, z[k - 1], z[k], t_s[k] - t_s[k - 1], scale)
        out[k] = take_value(kind, memory, z[k])
    return out


def remember(kind: int, scale: float, t_s: FloatArray, z: FloatArray) -> FloatArray:
    """Return the arguments [m] of a term with this memory along a variable z [m] at times t_s [m]."""
    if kind == DELAY:
        return np.asarray(np.interp(t_s - scale, t_s, z) - z)
    return np.asarray(_carry_along(kind, scale, t_s, np.ascontiguousarray(z)))
