"""Absorber ageing: the absorbed fraction falls with the light that the absorber has received."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import DOSE, HeatGainBound, Kernels, OperatingEnvelope, Term, TermValues


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by 1 − share · dose, with the dose relative to the recording's largest."""
    return float(x * (1.0 - v[0] * c[DOSE]))


class AbsorberAgeing(Term):
    """P (1 − share · dose), with the dose relative to the recording's largest."""

    key = "absorber_ageing"
    label = "the absorber ages and absorbs less"
    parameters = (TermParameter("share", "1", 0.05, -0.3, 0.3, "lost over the recording's whole dose, 1 to 20 %"),)
    kernels = Kernels(optical_power=optical_power)
    varies_between_runs = True
    is_linear = True
    signature = "the same pulse early and late in the session"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound | None:
        """Return no gain for an absorber that loses absorption, and no bound for one that gains it."""
        return HeatGainBound() if values["share"] >= 0.0 else None


TERM = AbsorberAgeing()
