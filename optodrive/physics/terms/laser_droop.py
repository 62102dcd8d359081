"""Laser droop: the diode's power falls as it warms within a pulse, and recovers between pulses."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import FULL_W, POWER_W, Kernels, Term


@kernel
def rates(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: FloatArray) -> None:
    """Let the warmth of chip and mount follow the relative power with their own time constants."""
    x[s] = (c[POWER_W] / c[FULL_W] - y[s]) / v[1]
    x[s + 1] = (c[POWER_W] / c[FULL_W] - y[s + 1]) / (v[1] * v[2])


@kernel
def optical_power(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Scale the power by 1 − share · mean warmth of chip and mount."""
    return float(x * (1.0 - 0.5 * v[0] * (y[s] + y[s + 1])))


class LaserDroop(Term):
    """P (1 − share · (h₁ + h₂)/2), with h₁, h₂ the warmth of chip and mount, which follow P / P_full."""

    key = "laser_droop"
    label = "the laser's power falls while it is on"
    parameters = (
        TermParameter("share", "1", 0.08, 0.0, 0.4, "power lost in the long run, 1 to 20 %"),
        TermParameter(
            "time", "s", 0.05, 2.5e-3, 2.0, "warming of chip and mount, 3 ms to 1 s", starts=(5e-3, 0.03, 0.2, 1.0)
        ),
        TermParameter("spread", "1", 1.5, 1.0, 30.0, "the mount's time over the chip's", is_shape=True),
    )
    followers = ("chip_1", "mount_1")
    has_laser_state = True
    kernels = Kernels(rates=rates, optical_power=optical_power)
    cannot_add_heat = True
    signature = "long pulses and trains, but not in cooling"


TERM = LaserDroop()
