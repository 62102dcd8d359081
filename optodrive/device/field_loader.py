"""Scan field and settling times of a configuration, the common source for planner, limiter and board limits."""

from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError
from optodrive.device.calibrated_field import CalibratedField
from optodrive.device.config import Config
from optodrive.device.field_file import load_field
from optodrive.device.pixel_map import build_aim_layout, load_pixel_map
from optodrive.device.scan_field import IdealField, ScanField
from optodrive.device.settling import SettlingTable

COVERAGE_SIGMAS = 2.0
"""Standard uncertainties of a field that scanner.aim_error_m must cover."""


def load_scan_field(config: Config) -> ScanField:
    """Return the calibrated field that the configuration names, else the ideal one.

    Raises InputError for a field of another scanner, and for one that does not reach every pixel within the configured
    aim error.
    """
    return _load_calibrated_field(config) or IdealField(config.scanner.focal_length_m)


def build_settling_table(config: Config) -> SettlingTable:
    """Return the settling times between the aim points of the pixels; raises as `load_scan_field`."""
    if load_pixel_map(config) is not None:
        return SettlingTable.from_config(config, load_scan_field(config))
    return SettlingTable.from_config(config, _load_calibrated_field(config))


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
        if abs(configured / calibrated - 1.0) > 1e-9:
            value = getattr(scanner, name)
            expected = (
                f"{value * calibrated / configured:.6g}, the value that {_describe(field, config)} was made with; "
                f"this display is {config.name}"
            )
            raise InputError(f"scanner.{name}", value, expected)


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
    required_m = COVERAGE_SIGMAS * float(sigma_m.max())
    if required_m > scanner.aim_error_m:
        expected = (
            f"at least {required_m:.2g}: {COVERAGE_SIGMAS:g} sigma at pixel {int(sigma_m.argmax())} of {config.name}, "
            f"by {_describe(field, config)}"
        )
        raise InputError("scanner.aim_error_m", scanner.aim_error_m, expected)
