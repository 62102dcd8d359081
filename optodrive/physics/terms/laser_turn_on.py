"""Laser turn-on: the diode reaches its power with a delay after the gate opens."""

from math import exp

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import SINCE_EDGE_S, Kernels, Term


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by 1 − e^(−t / time), with t the time since the gate opened."""
    return float(x * (1.0 - exp(-c[SINCE_EDGE_S] / v[0])))


class LaserTurnOn(Term):
    """P (1 − e^(−t / time)), with t the time since the gate opened."""

    key = "laser_turn_on"
    label = "the laser takes time to reach its power"
    parameters = (
        TermParameter(
            "time",
            "s",
            5e-4,
            1e-6,
            4e-3,
            "thermal and driver transients of blue diodes, 0.02 to 3 ms",
            starts=(1e-4, 4e-4, 1.5e-3),
        ),
    )
    kernels = Kernels(optical_power=optical_power)
    is_fast = True
    cannot_add_heat = True
    signature = "the first 2 ms of short pulses"


TERM = LaserTurnOn()
