"""Laser lag: the emitted power follows its command with a time constant, at both edges of a pulse."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import (
    POWER_W,
    SINCE_EDGE_S,
    HeatGainBound,
    Kernels,
    OperatingEnvelope,
    Term,
    TermValues,
)

SETTLING_SHARE = 0.1
"""Share of the time since an edge below which the time constant does not count: its effect has ended by then, and the
integrator's steps, a fifth of that time, stay stable."""
MIN_ABSORBER_TIME_S = 8e-3
"""Lower bound on the time constant of an absorber, s; Table S3 has 10 ms and more."""


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Let the emitted power follow the commanded one."""
    x[s] = (c[POWER_W] - y[s]) / max(v[0], SETTLING_SHARE * c[SINCE_EDGE_S])


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by the emitted share of the command."""
    return float(x * y[s] / c[POWER_W])


@kernel
def decaying_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add the power that is still emitted, W."""
    return float(x + y[s])


class LaserLag(Term):
    """time · dP/dt = P_command − P, when the gate opens and when it closes."""

    key = "laser_lag"
    label = "the laser follows its command with a time constant, at both edges"
    parameters = (
        TermParameter(
            "time", "s", 5e-4, 5e-6, 4e-3, "drivers with a filter, 0.02 to 3 ms", starts=(5e-5, 2e-4, 6e-4, 2e-3)
        ),
    )
    followers = ("emitted_w",)
    has_laser_state = True
    kernels = Kernels(rates=rates, optical_power=optical_power, decaying_power=decaying_power)
    is_fast = True
    signature = "the first milliseconds after either edge of a pulse"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return the gain of a decaying absorber, which the same energy reaches later: 1 / (1 − time / absorber's)."""
        return HeatGainBound(power_factor=1.0 / (1.0 - values["time"] / MIN_ABSORBER_TIME_S))


TERM = LaserLag()
