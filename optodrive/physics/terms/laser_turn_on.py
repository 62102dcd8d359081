"""The diode does not give full power at once when the gate opens."""

from math import exp

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import SINCE_EDGE_S, Kernels, Term, TermParameter


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """1 − e^(−t / time) of the power, t since the gate opened."""
    return float(x * (1.0 - exp(-c[SINCE_EDGE_S] / v[0])))


class LaserTurnOn(Term):
    """1 − e^(−t / time) of the power, t since the gate opened."""

    key = "laser_turn_on"
    parameters = (
        TermParameter("time", "s", 5e-4, 1e-5, 4e-3, "thermal and driver transients of blue diodes, 0.02 to 3 ms"),
    )
    kernels = Kernels(optical_power=optical_power)
    is_fast = True
    cannot_add_heat = True
    signature = "short pulses, the first 2 ms"


TERM = LaserTurnOn()
