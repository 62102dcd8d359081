"""Target height to pulse, for the nominal pixel: whole PWM periods at full power, the remainder made up by duty."""

from dataclasses import dataclass

from optodrive.core.kernels import kernel
from optodrive.physics.pixel import Pixel, advance, cooling_peak, gas_peak


@dataclass(frozen=True)
class DriveRange:
    """What one pulse can be: full power, the PWM period that widths are multiples of, and how many at most."""

    max_power_w: float
    period_s: float
    max_periods: int

    @classmethod
    def from_laser(cls, max_power_w: float, pwm_hz: float, width_max_s: float) -> "DriveRange":
        """The range for a laser (W, Hz) and the longest pulse allowed (s)."""
        return cls(max_power_w, 1.0 / pwm_hz, int(width_max_s * pwm_hz + 1e-9))


@kernel
def pulse_peak(pixel: Pixel, theta_k: float, gamma_k: float, power_w: float, width_s: float) -> tuple[float, float]:
    """Largest gas rise, K, after the start of a pulse on a pixel with these rises; its time from the start, s."""
    lit_k, lit_s = gas_peak(pixel, theta_k, gamma_k, power_w, width_s)
    theta_end_k, gamma_end_k = advance(pixel, theta_k, gamma_k, power_w, width_s)
    dark_k, dark_s = cooling_peak(pixel, theta_end_k, gamma_end_k)
    return (lit_k, lit_s) if lit_k > dark_k else (dark_k, width_s + dark_s)


@kernel
def _peak_after(
    pixel: Pixel, theta_k: float, gamma_k: float, power_w: float, width_s: float, peak_after_s: float
) -> tuple[float, float]:
    """As pulse_peak, counted only from from_s after the pulse's start on: all of it, or what follows its end."""
    if peak_after_s <= 0.0:
        return pulse_peak(pixel, theta_k, gamma_k, power_w, width_s)
    lit = advance(pixel, theta_k, gamma_k, power_w, width_s)
    dark_k, dark_s = cooling_peak(pixel, *advance(pixel, lit[0], lit[1], 0.0, max(0.0, peak_after_s - width_s)))
    return dark_k, max(width_s, peak_after_s) + dark_s


def max_displacement_m(pixel: Pixel, drive: DriveRange) -> float:
    """The largest displacement one pulse can reach from rest, m."""
    return pixel.kappa_m_per_k * pulse_peak(pixel, 0.0, 0.0, drive.max_power_w, drive.max_periods * drive.period_s)[0]


@kernel
def find_shortest_pulse(
    pixel: Pixel,
    theta_k: float,
    gamma_k: float,
    target_k: float,
    max_power_w: float,
    period_s: float,
    min_periods: int,
    max_periods: int,
    peak_after_s: float,
) -> tuple[int, float]:
    """PWM periods and duty of the shortest pulse whose peak gas rise is goal_k, given the heat still there.

    The pulse has least_periods at least, but never more than max_periods. from_s: the peak counts only from so long
    after the pulse's start on, beyond its end. No periods where the heat there reaches the goal by itself. A goal
    beyond the longest pulse gets the longest pulse.
    """
    if _peak_after(pixel, theta_k, gamma_k, 0.0, 0.0, peak_after_s)[0] >= target_k:
        return 0, 0.0
    low, high = min_periods - 1, max_periods
    while high - low > 1:
        middle = (low + high) // 2
        if _peak_after(pixel, theta_k, gamma_k, max_power_w, middle * period_s, peak_after_s)[0] >= target_k:
            high = middle
        else:
            low = middle
    return high, _solve_duty(pixel, theta_k, gamma_k, target_k, high * period_s, max_power_w, peak_after_s)


@kernel
def _solve_duty(
    pixel: Pixel,
    theta_k: float,
    gamma_k: float,
    target_k: float,
    width_s: float,
    max_power_w: float,
    peak_after_s: float,
) -> float:
    # The peak is a maximum over time of functions linear in duty, hence convex in duty: Newton from duty 1 falls
    # monotonically onto the root, and its slope is the gas response to full power at the time of the peak.
    full_theta_k, full_gamma_k = advance(pixel, 0.0, 0.0, max_power_w, width_s)
    duty = 1.0
    for _ in range(20):
        peak_k, at_s = _peak_after(pixel, theta_k, gamma_k, duty * max_power_w, width_s, peak_after_s)
        if at_s <= width_s:
            slope_k = advance(pixel, 0.0, 0.0, max_power_w, at_s)[1]
        else:
            slope_k = advance(pixel, full_theta_k, full_gamma_k, 0.0, at_s - width_s)[1]
        step = (peak_k - target_k) / slope_k
        duty -= step
        if abs(step) < 1e-9:
            break
    return min(1.0, duty)
