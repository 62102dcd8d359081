"""Sensor scale: the thermometer's gain is wrong."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import Hypothesis, RecordingScope, TermParameter
from optodrive.physics.term import Kernels, Term


@kernel
def sensor_reading(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Apply the gain to the rise and add the offset, K."""
    return float(v[0] * x + v[1])


class SensorScale(Term):
    """gain · θ + offset in place of the rise θ above ambient."""

    key = "sensor_scale"
    label = "the thermometer's scale is wrong"
    parameters = (
        TermParameter("gain", "1", 1.03, 0.85, 1.15, "emissivity taken wrongly by 10 %", neutral=1.0),
        TermParameter("offset", "K", 0.0, -20.0, 20.0, "reading at ambient", neutral=0.0),
    )
    kernels = Kernels(sensor_reading=sensor_reading)
    cannot_add_heat = True
    signature = "a reference temperature only"

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return the offset alone: a gain acts as R, C and κ together, and no data tells it from them."""
        start = {"gain": 1.0, "offset": 1.0}
        return [Hypothesis(self.key, f"{self.key}: offset", (start,), (self.free("offset"),), is_linear=True)]


TERM = SensorScale()
