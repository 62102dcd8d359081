"""Scan field and settling times of a configuration, the common source for planner, limiter and board limits."""

from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity
from optodrive.device.calibrated_field import CalibratedField, load_field
from optodrive.device.config import Config
from optodrive.device.config_sections import Wiring
from optodrive.device.pixel_map import build_aim_layout, load_pixel_map
from optodrive.device.scan_field import IdealField, ScanField
from optodrive.device.settling import SettlingTable

MOVE_MAX_S = 0.06
"""Longest settling time, that of one gate-off point: a board would be late with a move that takes several."""
COVERAGE_SIGMAS = 2.0
"""Standard uncertainties of a field that scanner.aim_error_m must cover."""


def load_scan_field(config: Config) -> ScanField:
    """Return the calibrated field that the configuration names, else the ideal one.

    Raises InputError for a field of another scanner, and for one that does not reach every pixel within the configured
    aim error.
    """
    return _load_calibrated_field(config) or IdealField(config.scanner.focal_length_m)


def build_settling_table(config: Config) -> SettlingTable:
    """Return the settling times between the aim points of the pixels.

    Raises as `load_scan_field`, and InputError for a servo that takes longer than MOVE_MAX_S across the display.
    """
    field = _load_calibrated_field(config) if load_pixel_map(config) is None else load_scan_field(config)
    table = SettlingTable.from_config(config, field)
    longest_s = 1e-6 * max(table.lead_in_us, *(times_us[-1] for times_us in table.after_short_dwell))
    if longest_s > MOVE_MAX_S:
        ramp_s = (len(table.after_short_dwell[0]) - 1) * table.pitch_rad / config.scanner.slew_rad_per_s
        key = "slew_rad_per_s" if ramp_s > 0.5 * longest_s else "bandwidth_hz"
        expected = (
            f"a servo that settles within {format_quantity(MOVE_MAX_S, 's')} across the display; this one takes "
            f"{format_quantity(longest_s, 's')}"
        )
        raise InputError(f"scanner.{key}", getattr(config.scanner, key), expected)
    return table


def _load_calibrated_field(config: Config) -> CalibratedField | None:
    if config.scanner.field is None:
        return None
    field = load_field(Path(config.scanner.field))
    _check_scanner(field, config)
    _check_pixels(field, config)
    return field


def _describe(field: CalibratedField, config: Config) -> str:
    """Return the name of the field's file and of the display that it was calibrated on."""
    return f"{config.scanner.field}, a field of {field.display or 'an unnamed display'}"


def _check_scanner(field: CalibratedField, config: Config) -> None:
    scanner = config.scanner
    for name, configured, calibrated in (
        ("range_rad", scanner.rad_per_code, field.rad_per_code),
        ("focal_length_m", scanner.focal_length_m, field.focal_length_m),
    ):
        # Exactly: a field maps codes, and another range or lens gives its codes another meaning.
        if abs(configured / calibrated - 1.0) > 1e-9:
            value = getattr(scanner, name)
            expected = (
                f"{value * calibrated / configured:.6g}, the value that {_describe(field, config)} was made with; "
                f"this display is {config.name}"
            )
            raise InputError(f"scanner.{name}", value, expected)
    for key, wired, calibrated_so in zip(Wiring._fields, scanner.wiring, field.wiring, strict=True):
        if wired != calibrated_so:
            expected = f"{str(calibrated_so).lower()}, as when {_describe(field, config)} was made; calibrate again"
            raise InputError(f"scanner.{key}", str(wired).lower(), expected)


def _check_pixels(field: CalibratedField, config: Config) -> None:
    layout, scanner = build_aim_layout(config), config.scanner
    x_code, y_code = field.codes(layout.x_m, layout.y_m)
    sigma_m = field.sigma_m(x_code, y_code)
    outside = np.flatnonzero(~np.isfinite(sigma_m))
    if len(outside):
        pixel = int(outside[0])
        place = f"{layout.x_m[pixel] * 1e3:.2f}, {layout.y_m[pixel] * 1e3:.2f} mm"
        reason = (
            "a position outside the converter's range"
            if np.isnan(x_code[pixel])
            else f"codes {x_code[pixel]:.0f}, {y_code[pixel]:.0f} outside its extent"
        )
        raise InputError(
            f"{scanner.field}: pixel {pixel} of {config.name} at {place}",
            reason,
            f"every pixel of {config.name} within {_describe(field, config)}",
        )
    # The gate's tolerance is what aim_error_m leaves: a field less certain than that would put light beside absorbers.
    required_m = COVERAGE_SIGMAS * float(sigma_m.max())
    if required_m > scanner.aim_error_m:
        expected = (
            f"at least {required_m:.2g}: {COVERAGE_SIGMAS:g} sigma at pixel {int(sigma_m.argmax())} of {config.name}, "
            f"by {_describe(field, config)}"
        )
        raise InputError("scanner.aim_error_m", scanner.aim_error_m, expected)
