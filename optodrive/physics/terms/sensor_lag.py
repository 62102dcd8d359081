"""The thermometer follows late."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import Kernels, Term, TermParameter


@kernel
def sensor_lag(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """First order, s."""
    return float(x + v[0])


class SensorLag(Term):
    """time · dT/dt = T_true − T, all of it later by delay_share × time (by `late_s` of what is observed)."""

    key = "sensor_lag"
    parameters = (
        TermParameter("time", "s", 5e-4, 2e-5, 5e-3, "0.05 to 3 ms, camera exposure or detector"),
        TermParameter("delay_share", "1", 0.0, 0.0, 1.0, "a delay beside it; 0.73 for an exposure's moving mean"),
    )
    kernels = Kernels(sensor_lag=sensor_lag)
    is_fast = True
    cannot_add_heat = True
    signature = "edges of temperature against edges of displacement"


TERM = SensorLag()
