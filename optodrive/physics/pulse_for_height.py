"""Pulse that reaches a target displacement on the nominal pixel: the fewest PWM periods, tuned by duty or width."""

from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.device.config import Config
from optodrive.physics.pixel import Pixel, advance, cooling_peak, gas_peak


@dataclass(frozen=True)
class DriveRange:
    """Range of one pulse: full power, the PWM period of which its width is a multiple, and the largest multiple.

    is_fine: pulses at full power that are longer than a period have any whole number of microseconds. The PWM does not
    switch at full power, so such a pulse has no phase.
    min_duty: power of the weakest pulse over full power; at 1, pulses of any length have any number of microseconds
    """

    max_power_w: float
    period_s: float
    max_periods: int
    is_fine: bool = False
    min_duty: float = 0.0

    @classmethod
    def from_laser(cls, max_power_w: float, pwm_hz: float, width_max_s: float) -> "DriveRange":
        """Return the range for a laser's power, W, and PWM frequency, Hz, and the longest pulse allowed, s."""
        # A width cap of whole periods must not lose one to rounding.
        return cls(max_power_w, 1.0 / pwm_hz, int(width_max_s * pwm_hz + 1e-9))

    @classmethod
    def from_config(cls, config: Config) -> "DriveRange":
        """Return the pulses that the only stage of a configuration may have. Those of a dimmed laser are whole periods.

        A weakest pulse is stated where it is more than a step of the duty, which the board rounds.
        """
        laser, limits = config.laser, config.limits
        drive = cls.from_laser(laser.max_power_w, laser.pwm_hz, limits.pulse_width_max_s)
        is_fine = laser.is_on_off or (not laser.whole_periods and limits.power_share == 1.0)
        has_weakest = laser.is_on_off or laser.threshold_w > 0.0
        min_duty = config.min_power_w / laser.max_power_w if has_weakest else 0.0
        return replace(drive, is_fine=is_fine, min_duty=min_duty)

    @property
    def is_on_off(self) -> bool:
        """Whether every pulse has full power."""
        return self.min_duty >= 1.0

    def build_pulse(self, energy_periods: float, min_periods: int = 1) -> tuple[float, float] | None:
        """Return periods and duty of the shortest pulse with an energy, in periods at full power, None for none."""
        if self.is_on_off:
            width_us = round_us(energy_periods * self.period_s)
            return (1e-6 * width_us / self.period_s, 1.0) if width_us > 0 else None
        periods = max(min_periods, ceil(energy_periods))
        duty = energy_periods / periods
        pulse = choose_permitted(periods, duty, min_periods, self.min_duty) if duty > 0.0 else (0.0, 0.0)
        return pulse if pulse[0] else None


@kernel
def pulse_peak(pixel: Pixel, theta_k: float, gamma_k: float, power_w: float, width_s: float) -> tuple[float, float]:
    """Return the peak gas rise, K, after the start of a pulse on a pixel with these rises, and its time, s."""
    on_k, on_s = gas_peak(pixel, theta_k, gamma_k, power_w, width_s)
    theta_end_k, gamma_end_k = advance(pixel, theta_k, gamma_k, power_w, width_s)
    # The gas lags behind the absorber: short pulses peak after their end.
    off_k, off_s = cooling_peak(pixel, theta_end_k, gamma_end_k)
    return (on_k, on_s) if on_k > off_k else (off_k, width_s + off_s)


@kernel
def _peak_after(
    pixel: Pixel, theta_k: float, gamma_k: float, power_w: float, width_s: float, peak_after_s: float
) -> tuple[float, float]:
    """Return `pulse_peak`, or for peak_after_s > 0 the peak from that time and from the pulse's end on."""
    if peak_after_s <= 0.0:
        return pulse_peak(pixel, theta_k, gamma_k, power_w, width_s)
    at_off = advance(pixel, theta_k, gamma_k, power_w, width_s)
    off_k, off_s = cooling_peak(pixel, *advance(pixel, at_off[0], at_off[1], 0.0, max(0.0, peak_after_s - width_s)))
    return off_k, max(width_s, peak_after_s) + off_s


def max_displacement_m(pixel: Pixel, drive: DriveRange) -> float:
    """Return the largest displacement that one pulse can reach on a cold pixel, m."""
    return pixel.kappa_m_per_k * pulse_peak(pixel, 0.0, 0.0, drive.max_power_w, drive.max_periods * drive.period_s)[0]


MIN_DUTY = 1e-6
"""Smallest duty of a pulse: below it, residual heat reaches the target but for rounding. A board's step is 1.5e-5."""


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
    is_fine: bool,
    min_duty: float,
    peak_after_s: float,
) -> tuple[float, float]:
    """Return PWM periods and duty of the shortest pulse whose peak gas rise is target_k, from the residual rises.

    The pulse has min_periods to max_periods, whole ones unless `DriveRange.is_fine`. peak_after_s: the peak counts only
    from this time after the pulse's start, and not before its end. Returns 0 periods if the residual heat already
    reaches the target, and the longest pulse if none reaches it; instead of a pulse weaker than min_duty, the nearest.
    """
    if _peak_after(pixel, theta_k, gamma_k, 0.0, 0.0, peak_after_s)[0] >= target_k:
        return 0.0, 0.0
    # Bisection over whole periods at full power: a wider pulse always peaks higher.
    low, high = min_periods - 1, max_periods
    while high - low > 1:
        middle = (low + high) // 2
        if _peak_after(pixel, theta_k, gamma_k, max_power_w, middle * period_s, peak_after_s)[0] >= target_k:
            high = middle
        else:
            low = middle
    if is_fine and (high > min_periods or min_duty >= 1.0):
        low_us, high_us = int(1e6 * low * period_s), round_us(high * period_s)
        while high_us - low_us > 1:
            middle_us = (low_us + high_us) // 2
            if _peak_after(pixel, theta_k, gamma_k, max_power_w, middle_us * 1e-6, peak_after_s)[0] >= target_k:
                high_us = middle_us
            else:
                low_us = middle_us
        low_k = _peak_after(pixel, theta_k, gamma_k, max_power_w, low_us * 1e-6, peak_after_s)[0]
        high_k = _peak_after(pixel, theta_k, gamma_k, max_power_w, high_us * 1e-6, peak_after_s)[0]
        return 1e-6 * (low_us if target_k - low_k < high_k - target_k else high_us) / period_s, 1.0
    duty = _solve_duty(pixel, theta_k, gamma_k, target_k, high * period_s, max_power_w, peak_after_s)
    return choose_permitted(high, duty, min_periods, min_duty) if duty > MIN_DUTY else (0.0, 0.0)


@kernel
def choose_permitted(periods: int, duty: float, min_periods: int, min_duty: float) -> tuple[float, float]:
    """Return periods and duty of the pulse, or 0 periods for none, that has the nearest energy and emits.

    A pulse of `periods` has at least min_duty, and a shorter one, of at least min_periods, full power.
    """
    if duty >= min_duty:
        return float(periods), duty
    shorter_duty = (periods - 1) / periods if periods > min_periods else 0.0
    if min_duty - duty <= duty - shorter_duty:
        return float(periods), min_duty
    return (float(periods - 1), 1.0) if periods > min_periods else (0.0, 0.0)


@kernel
def round_us(width_s: float) -> int:
    """Return a width in whole microseconds."""
    return int(np.rint(width_s * 1e6))


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
    """Return the duty at which the pulse's peak gas rise is target_k, by Newton's method.

    The peak is a maximum over time of functions linear in duty, hence convex in duty: Newton's method from duty 1
    decreases monotonically to the root. The slope is the gas's response to full power at the time of the peak.
    """
    full_theta_k, full_gamma_k = advance(pixel, 0.0, 0.0, max_power_w, width_s)
    duty = 1.0
    for _ in range(20):
        peak_k, at_s = _peak_after(pixel, theta_k, gamma_k, duty * max_power_w, width_s, peak_after_s)
        if at_s <= width_s:
            # The pixel is linear in power, so the slope is the response of a cold pixel to full power.
            slope_k = advance(pixel, 0.0, 0.0, max_power_w, at_s)[1]
        else:
            slope_k = advance(pixel, full_theta_k, full_gamma_k, 0.0, at_s - width_s)[1]
        step = (peak_k - target_k) / slope_k
        duty -= step
        if abs(step) < 1e-9:
            break
    return min(1.0, max(0.0, duty))  # rounding leaves a trace below 0 where the residual heat just fails
