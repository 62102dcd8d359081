"""The thermometer's gain is off."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import Kernels, Term, TermParameter


@kernel
def sensor_reading(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Gain on the rise, and an offset."""
    return float(v[0] * x + v[1])


class SensorScale(Term):
    """Gain on the absolute temperature."""

    key = "sensor_scale"
    parameters = (
        TermParameter("gain", "1", 1.03, 0.85, 1.15, "emissivity taken wrongly by 10 %"),
        TermParameter("offset", "K", 0.0, -20.0, 20.0, "what it shows at ambient"),
    )
    kernels = Kernels(sensor_reading=sensor_reading)
    cannot_add_heat = True
    signature = "only a reference temperature"


TERM = SensorScale()
