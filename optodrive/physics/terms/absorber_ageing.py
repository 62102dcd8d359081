"""The absorber absorbs less with the light it has had."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import DOSE, HeatGainBound, Kernels, OperatingEnvelope, Term, TermParameter, TermValues


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """1 − share × dose, dose as a share of the recording's."""
    return float(x * (1.0 - v[0] * c[DOSE]))


class AbsorberAgeing(Term):
    """1 − share × dose, dose as a share of the recording's."""

    key = "absorber_ageing"
    parameters = (TermParameter("share", "1", 0.05, -0.3, 0.3, "lost over the recording's whole dose, 1 to 20 %"),)
    kernels = Kernels(optical_power=optical_power)
    varies_between_runs = True
    signature = "the same pulse early and late"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound | None:
        """As new at the most; where light is absorbed better and better, nobody knows where that ends."""
        return HeatGainBound() if values["share"] >= 0.0 else None


TERM = AbsorberAgeing()
