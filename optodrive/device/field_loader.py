"""Which field a configuration aims by, and what the mirrors' moves take in it: one answer for all that ask.

Planner, limiter and board's limits must see the same angles.
"""

from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError
from optodrive.device.calibrated_field import Field
from optodrive.device.config import Config
from optodrive.device.field_file import read_field
from optodrive.device.pixel_map import aimed_layout, map_of
from optodrive.device.scan_field import AimedField, IdealField
from optodrive.device.settling import MoveModel

SURE = 2.0
"""So many sigmas of a field must lie within scanner.aim_error_m."""


def field_of(config: Config) -> AimedField:
    """The calibrated field where the configuration names one, else an ideal one.

    Raises InputError for a field of another scanner, or that does not lead to every pixel as surely as configured.
    """
    return _calibrated(config) or IdealField(config.scanner.focal_length_m)


def moves_of(config: Config) -> MoveModel:
    """Times of the mirrors' moves in that field, between where pixels are aimed at; raises as `field_of`."""
    if map_of(config) is not None:
        return MoveModel.of(config, field_of(config))
    return MoveModel.of(config, _calibrated(config))


def _calibrated(config: Config) -> Field | None:
    if config.scanner.field is None:
        return None
    field = read_field(Path(config.scanner.field))
    _check_scanner(field, config)
    _check_pixels(field, config)
    return field


def _check_scanner(field: Field, config: Config) -> None:
    scanner = config.scanner
    for name, own, made_for in (
        ("range_rad", scanner.code_rad, field.rad_per_code),
        ("focal_length_m", scanner.focal_length_m, field.focal_length_m),
    ):
        if abs(own / made_for - 1.0) > 1e-9:
            value = getattr(scanner, name)
            expected = f"{value * made_for / own:.6g}, what {scanner.field} was calibrated with"
            raise InputError(f"scanner.{name}", value, expected)


def _check_pixels(field: Field, config: Config) -> None:
    layout, scanner = aimed_layout(config), config.scanner
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
    unsure_m = SURE * float(sigma_m.max())
    if unsure_m > scanner.aim_error_m:
        expected = f"at least {unsure_m:.2g}: {SURE:g} sigma of {scanner.field} at pixel {int(sigma_m.argmax())}"
        raise InputError("scanner.aim_error_m", scanner.aim_error_m, expected)
