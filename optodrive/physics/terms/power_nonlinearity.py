"""Power nonlinearity: the laser's power is not proportional to its command, by a threshold or a curve."""

from optodrive.core.errors import InputError
from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import FULL_W, POWER_W, HeatGainBound, Kernels, OperatingEnvelope, Term, TermValues

START = 0.1


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Apply the threshold, then the curve, to the relative power. Full power stays full power."""
    if x <= 0.0:
        return x
    share, threshold = c[POWER_W] / c[FULL_W], v[0] / c[FULL_W]
    if threshold >= 1.0:
        return 0.0
    left = max(0.0, (share - threshold) / (1.0 - threshold))
    return float(x / share * left * (1.0 + v[1] * (1.0 - left)))


class PowerNonlinearity(Term):
    """q (1 + curvature · (1 − q)) with q = (p − threshold) / (1 − threshold), all relative to full power."""

    key = "power_nonlinearity"
    label = "the laser's power is not proportional to its command"
    parameters = (
        TermParameter(
            "threshold", "W", 0.05, 0.0, 0.5, "duty at which the diode begins to lase, in watts of command", neutral=0.0
        ),
        TermParameter("curvature", "1", 0.05, -0.3, 0.3, "bend of power against command, full power kept", neutral=0.0),
    )
    kernels = Kernels(optical_power=optical_power)
    signature = "a series of powers with unchanged pulse shapes"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return the curve's largest gain, which it reaches at low power. A threshold only reduces power.

        Raises InputError for a threshold that full power does not reach.
        """
        if values["threshold"] >= envelope.full_w:
            expected = f"less than the laser's full power, {envelope.full_w:g} W"
            raise InputError(f"terms.{self.key}.threshold", values["threshold"], expected)
        return HeatGainBound(power_factor=1.0 + max(0.0, values["curvature"]))

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one hypothesis per parameter if the recording has several powers. The curve alone is linear."""
        zero = {item.name: 0.0 for item in self.parameters}
        return [
            Hypothesis(
                self.key,
                f"{self.key}: {name}",
                (zero | {name: START},),
                (self.free(name),),
                is_linear=name == "curvature",
            )
            for name in zero
            if scope.power_levels > 1
        ]


TERM = PowerNonlinearity()
