"""The limiter's own closed form: an upper bound on absorber heat, and energy in sliding windows.

Written apart from `optodrive.physics` on purpose: what checks the limiter must not share its code.
"""

from bisect import bisect_right
from dataclasses import dataclass
from math import exp, expm1

from optodrive.flow import FloatArray, freeze_arrays


@dataclass(frozen=True, eq=False)
class Budget:
    """The caps, and the absorber's bound per pixel.

    gain_k_per_w: [p] steady rise per incident watt, declared uncertainty included; tau_s: [p] relaxation time
    rise_cap_k: largest absorber rise; the others as in the configuration's limits
    """

    gain_k_per_w: FloatArray
    tau_s: FloatArray
    rise_cap_k: float
    pulse_energy_max_j: float
    pulse_width_max_s: float
    pulse_rest_min_s: float
    pixel_mean_power_max_w: float
    pixel_mean_window_s: float
    display_mean_power_max_w: float
    display_mean_window_s: float

    def __post_init__(self) -> None:
        freeze_arrays(self)


def decayed_k(rise_k: float, dark_s: float, tau_s: float) -> float:
    """Bound on the rise after dark_s seconds without light, K."""
    return rise_k * exp(-dark_s / tau_s)


def power_for_rise_w(rise_k: float, cap_k: float, width_s: float, gain_k_per_w: float, tau_s: float) -> float:
    """Power, W, that takes the bound from rise_k to just cap_k within width_s; below zero when it passes it anyway."""
    return (cap_k - decayed_k(rise_k, width_s, tau_s)) / (gain_k_per_w * -expm1(-width_s / tau_s))


def heated_k(rise_k: float, power_w: float, width_s: float, gain_k_per_w: float, tau_s: float) -> float:
    """Bound on the rise at the end of a pulse, K."""
    return decayed_k(rise_k, width_s, tau_s) + gain_k_per_w * power_w * -expm1(-width_s / tau_s)


class EnergyWindow:
    """Energy delivered within any window of window_s seconds, exact for pulses of constant power in order of time."""

    def __init__(self, window_s: float, mean_power_max_w: float) -> None:
        self._window_s = window_s
        self._cap_j = window_s * mean_power_max_w
        self._start_s: list[float] = []
        self._width_s: list[float] = []
        self._power_w: list[float] = []
        self._before_j: list[float] = []
        self._total_j = 0.0

    def add(self, start_s: float, width_s: float, power_w: float) -> None:
        """Count a pulse; it starts no earlier than the last one ended."""
        self._start_s.append(start_s)
        self._width_s.append(width_s)
        self._power_w.append(power_w)
        self._before_j.append(self._total_j)
        self._total_j += width_s * power_w

    def _delivered_j(self, at_s: float) -> float:
        i = bisect_right(self._start_s, at_s) - 1
        if i < 0:
            return 0.0
        return self._before_j[i] + self._power_w[i] * min(at_s - self._start_s[i], self._width_s[i])

    def allowed_w(self, start_s: float, width_s: float) -> float:
        """Largest power of a next pulse that keeps every window ending within it at or below the cap, W."""
        end_s = start_s + width_s
        # The energy in the window is piecewise linear in its end; it can peak at the pulse's end, or where the
        # window's far edge meets the start of an earlier pulse.
        first = bisect_right(self._start_s, start_s - self._window_s)
        last = bisect_right(self._start_s, end_s - self._window_s)
        ends_s = [end_s, *(earlier_s + self._window_s for earlier_s in self._start_s[first:last])]
        return min(
            (self._cap_j - (self._total_j - self._delivered_j(t_s - self._window_s))) / (t_s - start_s)
            for t_s in ends_s
            if t_s > start_s
        )
