"""Power is not proportional to what is commanded: a threshold, or a curve."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import (
    FULL_W,
    POWER_W,
    HeatGainBound,
    Kernels,
    OperatingEnvelope,
    Term,
    TermParameter,
    TermValues,
)


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Full power kept: (p − threshold) / (1 − threshold), then p (1 + curvature (1 − p))."""
    if x <= 0.0:
        return x
    share, threshold = c[POWER_W] / c[FULL_W], v[0] / c[FULL_W]
    left = max(0.0, (share - threshold) / (1.0 - threshold))
    return float(x / share * left * (1.0 + v[1] * (1.0 - left)))


class PowerNonlinearity(Term):
    """Full power kept: (p − threshold) / (1 − threshold), then p (1 + curvature (1 − p))."""

    key = "power_nonlinearity"
    parameters = (
        TermParameter("threshold", "W", 0.05, 0.0, 0.5, "duty at which the diode begins to lase, in watts of command"),
        TermParameter("curvature", "1", 0.05, -0.3, 0.3, "bend of power against command, full power kept"),
    )
    kernels = Kernels(optical_power=optical_power)
    signature = "a ladder of powers, shapes unchanged"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """A threshold takes away; a curve gives the more, the weaker the light."""
        return HeatGainBound(power_factor=1.0 + max(0.0, values["curvature"]))


TERM = PowerNonlinearity()
