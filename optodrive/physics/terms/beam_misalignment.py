"""On one pixel part of the beam misses the absorber and warms its wall instead."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import (
    ILLUMINATED_PIXEL,
    IS_TARGET,
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
    """1 − share on that pixel."""
    return float(x * (1.0 - v[0]) if c[ILLUMINATED_PIXEL] == v[1] else x)


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """The wall warms towards resistance × what misses, while the light is on this pixel."""
    missing_w = v[0] * c[POWER_W] if c[ILLUMINATED_PIXEL] == v[1] and c[IS_TARGET] > 0.0 else 0.0
    x[s] = (v[2] * missing_w - y[s]) / v[3]


@kernel
def wall_rise(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Rise of the bridge's far end, K."""
    return float(x + y[s])


class BeamMisalignment(Term):
    """P (1 − share) on one pixel; the rest warms its wall."""

    key = "beam_misalignment"
    parameters = (
        TermParameter("share", "1", 0.1, 0.0, 0.5, "missing the absorber, 2 to 30 %"),
        TermParameter("pixel", "1", 0.0, 0.0, 1e6, "the pixel's index"),
        TermParameter("resistance", "K/W", 4.0, 0.01, 60.0, "the wall to its surroundings, 1 to 40 K/W"),
        TermParameter("time", "s", 0.5, 0.02, 20.0, "the wall's, 0.1 to 10 s"),
    )
    followers = ("missed_k",)
    kernels = Kernels(optical_power=optical_power, rates=rates, wall_rise=wall_rise)
    signature = "several pixels beside each other"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """The wall under what misses at full power for ever."""
        return HeatGainBound(uniform_rise_k=values["resistance"] * values["share"] * envelope.full_w)


TERM = BeamMisalignment()
