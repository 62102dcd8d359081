"""The room moves while its stated temperature does not."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import (
    SESSION_TIME,
    TIME_S,
    HeatGainBound,
    Kernels,
    OperatingEnvelope,
    Term,
    TermParameter,
    TermValues,
)


@kernel
def sensor_reading(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Ramp and parabola in the session's time, −1 to 1, and a rate in the run's."""
    u = c[SESSION_TIME]
    return float(x + v[0] + v[1] * u + v[2] * (1.5 * u * u - 0.5) + v[3] * c[TIME_S])


class AmbientDrift(Term):
    """Ramp and parabola in the session's time, −1 to 1, and a rate in the run's."""

    key = "ambient_drift"
    parameters = (
        TermParameter("offset", "K", 0.5, -10.0, 10.0, "the room against what is stated, within 5 K"),
        TermParameter("ramp", "K", 0.5, -10.0, 10.0, "over the recording, within 5 K"),
        TermParameter("bend", "K", 0.2, -10.0, 10.0, "a parabola over the recording"),
        TermParameter("rate", "K/s", 0.05, -10.0, 10.0, "within a run"),
    )
    kernels = Kernels(sensor_reading=sensor_reading)
    varies_between_runs = True
    signature = "baselines before the pulse"

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound:
        """A room as much warmer than stated as it ever was."""
        return HeatGainBound(uniform_rise_k=abs(values["offset"]) + abs(values["ramp"]) + abs(values["bend"]))


TERM = AmbientDrift()
