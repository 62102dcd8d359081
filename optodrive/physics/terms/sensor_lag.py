"""Sensor lag: the thermometer follows the absorber with a lag and a delay."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import BySignal, Kernels, Term, TermValues


@kernel
def sensor_lag(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add the thermometer's time constant, s."""
    return float(x + v[0])


class SensorLag(Term):
    """time · dT/dt = T_true − T, delayed as a whole by delay_share · time."""

    key = "sensor_lag"
    label = "the thermometer lags"
    parameters = (
        TermParameter(
            "time", "s", 5e-4, 1e-6, 5e-3, "0.05 to 3 ms, camera exposure or detector", starts=(1e-4, 5e-4, 2e-3)
        ),
        TermParameter(
            "delay_share",
            "1",
            0.0,
            0.0,
            1.0,
            "additional delay; 0.73 for the moving mean of an exposure",
            starts=(0.0, 0.7),
            is_shape=True,
        ),
    )
    kernels = Kernels(sensor_lag=sensor_lag)
    is_fast = True
    cannot_add_heat = True
    signature = "edges of temperature against those of displacement"
    remedy = "record a step of light with a faster detector, or at a shorter exposure."

    def signal_delays(self, values: TermValues) -> BySignal:
        """Return the thermometer's delay."""
        return BySignal(temperature=values["time"] * values["delay_share"])


TERM = SensorLag()
