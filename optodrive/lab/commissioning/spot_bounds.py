"""Bounds of a single spot: its power and width, and the time in which the mirrors settle before it."""

from math import ceil, pi

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.quantity import format_number
from optodrive.device.config import Config

SPOT_POWER_MAX_W = 0.05
"""Maximum power of a spot: 2 % of a pixel's drive power; steady on one absorber it adds a few kelvin."""
SPOT_SHARE_MAX = 0.05
"""Maximum power of a spot relative to the laser's power."""
SPOT_WIDTH_S = 0.02
SETTLING_TIME_CONSTANTS = 15.0
"""Settling time after a move in time constants of the servo."""


def max_settling_s(config: Config) -> float:
    """Return the gate-off time in which any move settles, s, rounded up to milliseconds."""
    scanner = config.scanner
    ramp_s = 2.0 * scanner.range_rad / scanner.slew_rad_per_s
    constant_s = 1.0 / (2.0 * pi * scanner.bandwidth_hz * scanner.damping)
    return ceil(1e3 * (scanner.delay_s + ramp_s + SETTLING_TIME_CONSTANTS * constant_s)) * 1e-3


def spot_width_s(config: Config) -> float:
    """Return the width of a spot's pulse, s: whole PWM periods within the configured maximum."""
    pwm_hz = config.laser.pwm_hz
    periods = max(1, int(min(SPOT_WIDTH_S, config.limits.pulse_width_max_s) * pwm_hz * (1 + 1e-9)))
    return round(periods / pwm_hz * 1e6) * 1e-6


def max_spot_power_w(config: Config) -> float:
    """Return the maximum power of a spot, W."""
    return min(SPOT_POWER_MAX_W, SPOT_SHARE_MAX * config.laser.max_power_w)


def check_spot_power(config: Config, power_w: float, option: str = "--spot-power-mw") -> None:
    """Raise InputError, naming the option, for a power outside the range of a spot."""
    max_w, threshold_w = max_spot_power_w(config), config.laser.threshold_w
    if 0.0 < power_w < threshold_w:
        expected = f"at least laser.threshold_w, {format_number(threshold_w * 1e3)} mW, below which nothing is emitted"
        raise InputError(option, Unquoted(f"{power_w * 1e3:g} mW"), expected)
    if not 0.0 < power_w <= max_w:
        raise InputError(
            option, Unquoted(f"{power_w * 1e3:g} mW"), f"more than 0 and at most {format_number(max_w * 1e3)} mW"
        )
