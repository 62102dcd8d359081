"""A diode that warms gives less: power falls within a pulse and recovers between."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import FULL_W, POWER_W, Kernels, Term, TermParameter


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """The diode's warmth follows the gate."""
    x[s] = (c[POWER_W] / c[FULL_W] - y[s]) / v[1]
    x[s + 1] = (c[POWER_W] / c[FULL_W] - y[s + 1]) / (v[1] * v[2])


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """P (1 − share × mean warmth of chip and mount)."""
    return float(x * (1.0 - 0.5 * v[0] * (y[s] + y[s + 1])))


class LaserDroop(Term):
    """The diode's warmth follows the gate."""

    key = "laser_droop"
    parameters = (
        TermParameter("share", "1", 0.08, 0.0, 0.4, "power lost in the long run, 1 to 20 %"),
        TermParameter("time", "s", 0.05, 2.5e-3, 2.0, "warming of chip and mount, 3 ms to 1 s"),
        TermParameter("spread", "1", 1.5, 1.0, 30.0, "the mount's time over the chip's"),
    )
    followers = ("chip_1", "mount_1")
    kernels = Kernels(rates=rates, optical_power=optical_power)
    cannot_add_heat = True
    signature = "long pulses and trains, nothing in cooling"


TERM = LaserDroop()
