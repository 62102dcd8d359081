"""Which field a configuration aims by, and what the mirrors' moves take in it: one answer for all that ask.

Planner, limiter and board's limits must see the same angles.
"""

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
"""So many sigmas of a field must lie within scanner.aim_error_m."""


def load_scan_field(config: Config) -> ScanField:
    """The calibrated field where the configuration names one, else an ideal one.

    Raises InputError for a field of another scanner, or that does not lead to every pixel as surely as configured.
    """
    return _load_calibrated_field(config) or IdealField(config.scanner.focal_length_m)


def build_settling_table(config: Config) -> SettlingTable:
    """Times of the mirrors' moves in that field, between where pixels are aimed at; raises as `field_of`."""
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


def _check_scanner(field: CalibratedField, config: Config) -> None:
    scanner = config.scanner
    for name, own, made_for in (
        ("range_rad", scanner.rad_per_code, field.rad_per_code),
        ("focal_length_m", scanner.focal_length_m, field.focal_length_m),
    ):
        if abs(own / made_for - 1.0) > 1e-9:
            value = getattr(scanner, name)
            expected = f"{value * made_for / own:.6g}, what {scanner.field} was calibrated with"
            raise InputError(f"scanner.{name}", value, expected)


def _check_pixels(field: CalibratedField, config: Config) -> None:
    layout, scanner = build_aim_layout(config), config.scanner
    x_code, y_code = field.codes(layout.x_m, layout.y_m)
    sigma_m = field.sigma_m(x_code, y_code)
    beyond = np.flatnonzero(~np.isfinite(sigma_m))
    if len(beyond):
        pixel = int(beyond[0])
        place = f"{layout.x_m[pixel] * 1e3:.2f}, {layout.y_m[pixel] * 1e3:.2f} mm"
        why = (
            "a place no code of the converter reaches"
            if np.isnan(x_code[pixel])
            else f"codes {x_code[pixel]:.0f}, {y_code[pixel]:.0f}, for which it was not made"
        )
        raise InputError(f"{scanner.field}: pixel {pixel} at {place}", why, "every pixel within the calibrated field")
    unsure_m = COVERAGE_SIGMAS * float(sigma_m.max())
    if unsure_m > scanner.aim_error_m:
        expected = (
            f"at least {unsure_m:.2g}: {COVERAGE_SIGMAS:g} sigma of {scanner.field} at pixel {int(sigma_m.argmax())}"
        )
        raise InputError("scanner.aim_error_m", scanner.aim_error_m, expected)
