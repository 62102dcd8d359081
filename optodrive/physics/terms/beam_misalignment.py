"""Beam misalignment: on one pixel, part of the beam misses the absorber and heats its wall instead."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import (
    ILLUMINATED_PIXEL,
    IS_TARGET,
    POWER_W,
    HeatGainBound,
    Kernels,
    OperatingEnvelope,
    Term,
    TermValues,
    add_follower,
)


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by 1 − share on the misaligned pixel."""
    return float(x * (1.0 - v[0]) if c[ILLUMINATED_PIXEL] == v[1] else x)


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Heat the wall towards resistance · missing power while the misaligned pixel is illuminated."""
    missing_w = v[0] * c[POWER_W] if c[ILLUMINATED_PIXEL] == v[1] and c[IS_TARGET] > 0.0 else 0.0
    x[s] = (v[2] * missing_w - y[s]) / v[3]


class BeamMisalignment(Term):
    """P (1 − share) on one pixel. The rest heats its wall: time · dm/dt = resistance · share · P − m."""

    key = "beam_misalignment"
    label = "on one pixel part of the beam misses the absorber"
    parameters = (
        TermParameter("share", "1", 0.1, 0.0, 0.5, "missing the absorber, 2 to 30 %"),
        TermParameter("pixel", "1", 0.0, 0.0, 1e6, "the pixel's index"),
        TermParameter("resistance", "K/W", 4.0, 0.01, 60.0, "the wall to its surroundings, 1 to 40 K/W"),
        TermParameter("time", "s", 0.5, 0.02, 20.0, "the wall's, 0.1 to 10 s"),
    )
    followers = ("missed_k",)
    kernels = Kernels(optical_power=optical_power, rates=rates, wall_rise=add_follower)
    signature = "a comparison of several pixels"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return the wall's steady rise under continuous full power as a rise of everything."""
        return HeatGainBound(uniform_rise_k=values["resistance"] * values["share"] * envelope.all_power_w)

    def affected_pixel(self, values: TermValues) -> int | None:
        """Return the index of the misaligned pixel."""
        return int(values["pixel"])

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one hypothesis per measured and illuminated pixel, if there is a second one to compare it with."""
        free = tuple(self.free(name) for name in ("share", "resistance", "time"))
        start = {item.name: item.default for item in self.parameters}
        return [
            Hypothesis(self.key, f"{self.key} of pixel {pixel}", (start | {"pixel": float(pixel)},), free)
            for pixel in scope.pixels
            if pixel in scope.illuminated and len(scope.pixels) > 1
        ]


TERM = BeamMisalignment()
