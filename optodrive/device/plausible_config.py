"""Plausible values of a configuration's quantities, checked before its types: a wrong unit is told as such."""

from pathlib import Path
from typing import Any

from optodrive.core.errors import InputError
from optodrive.core.plausibility import PlausibleRange, check_plausible, guess_unit
from optodrive.core.units import ZERO_CELSIUS_K

SERVO_RANGES = {
    "bandwidth_hz": PlausibleRange(100.0, 1e5, "Hz"),
    "delay_s": PlausibleRange(1e-9, 2e-3, "s"),
    "slew_rad_per_s": PlausibleRange(1.0, 1500.0, "rad/s"),
}
RANGES = {
    "ambient_c": PlausibleRange(0.0, 60.0, "°C"),
    "display.pitch_m": PlausibleRange(1e-4, 0.1, "m"),
    "display.bridge_width_m": PlausibleRange(1e-5, 5e-3, "m"),
    "display.absorber_width_m": PlausibleRange(5e-5, 0.05, "m"),
    "display.absorber_height_m": PlausibleRange(5e-5, 0.05, "m"),
    "laser.max_power_w": PlausibleRange(1e-3, 60.0, "W"),
    "laser.pwm_hz": PlausibleRange(50.0, 1e7, "Hz"),
    "laser.focus_width_m": PlausibleRange(1e-6, 0.05, "m"),
    "laser.focus_height_m": PlausibleRange(1e-6, 0.05, "m"),
    "scanner.focal_length_m": PlausibleRange(5e-3, 3.0, "m"),
    "scanner.range_rad": PlausibleRange(1e-3, 0.8, "rad"),
    "scanner.aim_error_m": PlausibleRange(1e-9, 5e-3, "m"),
    "limits.absorber_max_c": PlausibleRange(1.0, 560.0, "°C"),
    "limits.wall_max_c": PlausibleRange(1.0, 200.0, "°C"),
    "limits.touch_max_c": PlausibleRange(1.0, 90.0, "°C"),
    "limits.galvo_acceleration_rms_max_rad_per_s2": PlausibleRange(1.0, 1e6, "rad/s²"),
    "limits.galvo_mean_s": PlausibleRange(1e-3, 100.0, "s"),
    "limits.pulse_energy_max_j": PlausibleRange(1e-6, 10.0, "J"),
    "limits.pulse_width_max_s": PlausibleRange(1e-7, 0.07, "s"),
    "limits.pulse_gap_min_s": PlausibleRange(1e-9, 0.01, "s"),
    "limits.pixel_mean_power_max_w": PlausibleRange(1e-4, 60.0, "W"),
    "limits.pixel_mean_window_s": PlausibleRange(1e-3, 120.0, "s"),
    "limits.display_mean_power_max_w": PlausibleRange(1e-4, 60.0, "W"),
    "limits.display_mean_window_s": PlausibleRange(1e-3, 120.0, "s"),
    "board.lease_s": PlausibleRange(1e-3, 1.0, "s"),
    **{f"scanner.{key}": item for key, item in SERVO_RANGES.items()},
}
"""Ranges of absolute values by key; a value that the schema refuses is told here first if a unit explains it."""
UNCERTAINTY_RANGE = PlausibleRange(0.0, 0.5, "1")
KELVIN_CAP_MIN = 423.0
"""Absorber caps from here on, 150 °C in K, are taken for K if they are round in °C and not as they stand."""
ROUND_C = 5.0


def check_units(path: Path, table: dict[str, Any]) -> None:
    """Raise InputError for the first quantity of a configuration whose value suits another unit than its own."""
    for key, plausible in RANGES.items():
        value = _look_up(table, key)
        if value is not None and _is_explained(value, plausible):
            check_plausible(f"{path}: {key}", value, plausible)
    for key in _look_up_section(table, "limits.uncertainty"):
        value = _look_up(table, f"limits.uncertainty.{key}")
        if value is not None and _is_explained(value, UNCERTAINTY_RANGE):
            check_plausible(f"{path}: limits.uncertainty.{key}", value, UNCERTAINTY_RANGE)
    cap_c = _look_up(table, "limits.absorber_max_c")
    if cap_c is not None and cap_c >= KELVIN_CAP_MIN and cap_c % ROUND_C and _is_round(cap_c):
        expected = f"°C; this value is likely in K, {cap_c - ZERO_CELSIUS_K:.0f} °C"
        raise InputError(f"{path}: limits.absorber_max_c", cap_c, expected, "unit")


def check_servo_units(path: Path, table: dict[str, Any]) -> None:
    """Raise InputError for the first quantity of mirrors.toml whose value suits another unit than its own."""
    for key, plausible in SERVO_RANGES.items():
        value = _look_up(table, f"scanner.{key}")
        if value is not None and _is_explained(value, plausible):
            check_plausible(f"{path}: scanner.{key}", value, plausible)


def _is_explained(value: float, plausible: PlausibleRange) -> bool:
    """Return whether another unit explains a value; any other value is left to the schema."""
    return guess_unit(value, plausible) is not None


def _is_round(cap_k: float) -> bool:
    return any(abs((cap_k - zero) % ROUND_C) < 1e-6 for zero in (273.0, ZERO_CELSIUS_K))


def _look_up_section(table: dict[str, Any], place: str) -> dict[str, Any]:
    section: Any = table
    for part in place.split(".") if place else ():
        section = section.get(part) if isinstance(section, dict) else None
    return section if isinstance(section, dict) else {}


def _look_up(table: dict[str, Any], key: str) -> float | None:
    place, _, name = key.rpartition(".")
    value = _look_up_section(table, place).get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
