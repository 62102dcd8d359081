"""Ambient drift: the ambient temperature differs from the stated one and changes."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import SESSION_TIME, TIME_S, HeatGainBound, Kernels, OperatingEnvelope, Term, TermValues

FREE = (("offset",), ("offset", "ramp", "bend"), ("offset", "ramp", "bend", "rate"), ("rate",))
"""Sets of parameters that are fitted together, one hypothesis each."""


@kernel
def sensor_reading(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add an offset, a ramp and a parabola in session time, and a ramp in the run's time."""
    u = c[SESSION_TIME]
    return float(x + v[0] + v[1] * u + v[2] * (1.5 * u * u - 0.5) + v[3] * c[TIME_S])


class AmbientDrift(Term):
    """offset + ramp · u + bend · (3u² − 1)/2 + rate · t, with u the session time from −1 to 1 and t the run's time."""

    key = "ambient_drift"
    label = "the ambient temperature differs from the stated one"
    parameters = (
        TermParameter("offset", "K", 0.5, -10.0, 10.0, "ambient against stated temperature, within 5 K", neutral=0.0),
        TermParameter("ramp", "K", 0.5, -10.0, 10.0, "over the recording, within 5 K", neutral=0.0),
        TermParameter("bend", "K", 0.2, -10.0, 10.0, "a parabola over the recording", neutral=0.0),
        TermParameter("rate", "K/s", 0.05, -10.0, 10.0, "within a run", neutral=0.0),
    )
    kernels = Kernels(sensor_reading=sensor_reading)
    varies_between_runs = True
    signature = "baselines before the pulse"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """Return the largest excess of the ambient over the stated temperature as a rise of everything."""
        return HeatGainBound(uniform_rise_k=abs(values["offset"]) + abs(values["ramp"]) + abs(values["bend"]))

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return one linear hypothesis per set of `FREE`, started at 1 in each of its parameters."""
        zero = {item.name: 0.0 for item in self.parameters}
        return [
            Hypothesis(
                self.key,
                f"{self.key}: {names[-1]}",
                tuple(zero | {name: 1.0} for name in names),
                tuple(self.free(name) for name in names),
                is_linear=True,
            )
            for names in FREE
        ]


TERM = AmbientDrift()
