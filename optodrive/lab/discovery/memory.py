"""Memories: inner states by which a term depends on the past of a variable, one but for an oscillation.

Theory of operation. Each is carried over a step in closed form, exact for a variable z that is linear in time between.
A lag follows z with a time constant. Presliding friction depends on the way of z alone, not on time: it tends to the
sign of the motion over a distance, exponentially (Dahl), or linearly with an end (an elastic element that slips, after
Maxwell; Bouc–Wen lies between). A delay is z itself at an earlier time. An oscillation is what z pulls by a spring and
a damper: its second state is its rate.
"""

from math import cos, exp, expm1, sin, sqrt

import numpy as np

from optodrive.core.kernels import array_kernel, kernel
from optodrive.core.types.arrays import FloatArray

NONE, LAG, FOLLOWER, DAHL, SLIP, DELAY, OSCILLATION = range(7)
PATH = (DAHL, SLIP)
"""Memories whose scale is a distance of the variable, not a time."""
FILTERS = (LAG, FOLLOWER, DELAY, OSCILLATION)
"""Memories that are linear filters of their variable: records of inputs and outputs hardly tell where one stands."""
TEXTS = {
    LAG: "m, m' = ({z} - m) / {s}",
    FOLLOWER: "(m - {z}), m' = ({z} - m) / {s}",
    DAHL: "h, h' = ({z}' - |{z}'| h) / {s}",
    SLIP: "h, h' = {z}' / {s} within -1 and 1",
    DELAY: "({z}(t - {s}) - {z})",
    OSCILLATION: "(m - {z}), m'' = ({z} - m) / {s}^2 - 2 {d} m' / {s}",
}
KINDS = ("hysteresis", "delay", "oscillation", "creep", "lag", "second node")
"""Classes of terms with memory."""
START_DAMPING, MIN_DAMPING, MAX_DAMPING = 0.1, 5e-3, 0.7
"""Damping ratio of an oscillation; what is damped more is a lag."""


def name_memory(kind: int, is_output: bool, is_state: bool) -> str:
    """Return the class of a term with memory.

    What follows a state and acts on its equation is a second node beside it.
    """
    if kind in PATH:
        return "hysteresis"
    if kind in (DELAY, OSCILLATION):
        return "delay" if kind == DELAY else "oscillation"
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
def oscillate(
    before: float, rate: float, z0: float, z: float, dt: float, scale: float, damping: float
) -> tuple[float, float]:
    """Return an oscillation and its rate after dt in which its variable went from z0 to z. scale: 1 / ω."""
    if not dt > 0.0:
        return before, rate
    slope = (z - z0) / dt
    late = 2.0 * damping * scale * slope  # behind a ramp it stays by this
    apart, towards = before - z0 + late, rate - slope
    decay, turn = damping / scale, sqrt(1.0 - damping * damping) / scale
    fall, c, s = exp(-decay * dt), cos(turn * dt), sin(turn * dt)
    share = (towards + decay * apart) / turn
    moved = fall * (apart * c + share * s)
    return float(z - late + moved), float(slope - decay * moved + fall * turn * (share * c - apart * s))


@kernel
def start_memory(kind: int, z: float) -> float:
    """Return a memory at the start of a record, as after a long rest at z."""
    return 0.0 if kind in (DAHL, SLIP) else z


@kernel
def take_value(kind: int, memory: float, z: float) -> float:
    """Return the argument of a term."""
    return memory - z if kind in (FOLLOWER, DELAY, OSCILLATION) else memory


@array_kernel
def _carry_along(kind: int, scale: float, t_s: FloatArray, z: FloatArray) -> FloatArray:
    out, rate = np.zeros(len(z)), 0.0
    memory = start_memory(kind, z[0])
    out[0] = take_value(kind, memory, z[0])
    for k in range(1, len(z)):
        dt = t_s[k] - t_s[k - 1]
        if kind == OSCILLATION:
            memory, rate = oscillate(memory, rate, z[k - 1], z[k], dt, scale, START_DAMPING)
        else:
            memory = carry(kind, memory, z[k - 1], z[k], dt, scale)
        out[k] = take_value(kind, memory, z[k])
    return out


def remember(kind: int, scale: float, t_s: FloatArray, z: FloatArray) -> FloatArray:
    """Return the arguments [m] of a term with this memory along a variable z [m] at times t_s [m]."""
    if kind == DELAY:
        return np.asarray(np.interp(t_s - scale, t_s, z) - z)
    return np.asarray(_carry_along(kind, scale, t_s, np.ascontiguousarray(z)))
