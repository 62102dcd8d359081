"""Measured spots of the beam, and the prior of a field.

A spot is a pair of codes with the place on the display at which the beam stood. The prior of a field is its nominal
geometry with the mechanical tolerances of an ordinary laboratory.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.numeric_tables import read_columns, read_comments, write_columns
from optodrive.core.types.arrays import FloatArray, ReadOnlyArrays
from optodrive.device.calibrated_field import Extent
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.config_sections import DIRECT_WIRING, Wiring
from optodrive.device.field_geometry import CENTRE_CODE, CODE_MAX, FieldGeometry

COLUMNS = ("x_code", "y_code", "x_m", "y_m")
ORIGIN = "optodrive spots of "
"""Beginning of the comment that names the display."""
MARGIN_M = 5e-3
"""Margin of the field beyond the pixels on every side, m; uncorrected codes miss by millimetres."""
HALF_EXTENT_MIN_M = 1e-3
"""Smallest half extent of a display, m; a single pixel has none."""
SPOT_NOISE_M = 10e-6
"""Expected noise of a spot, rms per axis, m; fitted if the spots suffice."""
SURFACE_RMS_M = 12e-6
"""Expected surface, rms per axis, m; fitted if the spots suffice."""


@dataclass(frozen=True, eq=False)
class MeasuredSpots(ReadOnlyArrays):
    """Codes of the converter, and positions of the beam on the display, m, all [n]."""

    x_code: FloatArray
    y_code: FloatArray
    x_m: FloatArray
    y_m: FloatArray

    def __len__(self) -> int:
        return len(self.x_code)

    @classmethod
    def from_table(cls, table: FloatArray) -> Self:
        """Build spots from rows of x_code, y_code, x_m, y_m, [n, 4]."""
        x_code, y_code, x_m, y_m = np.array(table, dtype=np.float64).reshape(-1, 4).T.copy()
        return cls(x_code, y_code, x_m, y_m)

    def to_table(self) -> FloatArray:
        """Return rows of x_code, y_code, x_m, y_m, [n, 4]."""
        return np.column_stack([self.x_code, self.y_code, self.x_m, self.y_m])


def read_spots(path: Path, display: str = "") -> MeasuredSpots:
    """Read spots.csv. Raise InputError with file, row, column, value and expected value.

    display: name of the display, of which the spots must be if they name theirs; empty: any
    """
    table = read_columns(path, COLUMNS)
    comments = read_comments(path)
    named = next((line.removeprefix(ORIGIN) for line in comments if line.startswith(ORIGIN)), "")
    if display and named and named != display:
        raise InputError(f"{path}: spots", f"those of {named}", f"those of {display}, the configured display")
    if len(table) and np.all(np.abs(table[:, :2]) < 1.0) and np.any(table[:, :2]):
        swapped = np.abs(table[:, 2:]).max() > 100.0
        hint = ", with the columns of codes and of metres exchanged" if swapped else ""
        expected = f"codes of the converter, 0 to 65535; these look like metres{hint}"
        raise InputError(f"{path}: x_code, y_code", float(table[0, 0]), expected)
    bad = np.argwhere((table[:, :2] < 0) | (table[:, :2] > CODE_MAX))
    if len(bad):
        row, column = bad[0].tolist()
        place = f"{path}: row {row + find_first_line(path)}: {COLUMNS[column]}"
        raise InputError(place, float(table[row, column]), f"0 to {CODE_MAX}")
    _, first, copies = np.unique(table, axis=0, return_index=True, return_inverse=True)
    original = first[copies.ravel()]
    repeated = np.flatnonzero(original != np.arange(len(table)))
    if len(repeated):
        row, line = int(repeated[0]), find_first_line(path)
        found = f"the numbers of row {original[row] + line}, as {len(repeated)} rows in all repeat others"
        expected = "each measurement once: copies would make the field look more certain than it is"
        raise InputError(f"{path}: row {row + line}", Unquoted(found), expected)
    return MeasuredSpots.from_table(table)


def find_first_line(path: Path) -> int:
    """Return the line number of the first spot in a file."""
    return len(read_comments(path)) + 2


def write_spots(path: Path, spots: MeasuredSpots, display: str) -> None:
    """Write spots.csv atomically.

    display: name of the display that they were measured on
    """
    write_columns(path, COLUMNS, spots.to_table(), ("%.17g", "%.17g", "%.9g", "%.9g"), f"{ORIGIN}{display}")


@dataclass(frozen=True, eq=False)
class FieldPrior(ReadOnlyArrays):
    """Prior distribution of a field's parameters.

    mean, sigma: of each parameter of the geometry; extent: codes of the field; display_extent: codes of the display
    rad_per_code, focal_length_m, wiring: of the configuration; noise_m, surface_m: expected rms per axis
    field_area_m2: area over which outliers are uniformly distributed; display: name of the display
    """

    mean: FieldGeometry
    sigma: FloatArray
    rad_per_code: float
    focal_length_m: float
    extent: Extent
    display_extent: Extent
    field_area_m2: float
    noise_m: float = SPOT_NOISE_M
    surface_m: float = SURFACE_RMS_M
    display: str = ""
    wiring: Wiring = DIRECT_WIRING

    @classmethod
    def from_config(cls, config: Config) -> Self:
        """Build the prior from a configuration's nominal values and the tolerances of an ordinary laboratory."""
        scanner, layout = config.scanner, build_pixel_layout(config.display)
        focal_m, range_rad = scanner.focal_length_m, scanner.range_rad
        display_m = [max(HALF_EXTENT_MIN_M, float(np.abs(axis).max())) for axis in (layout.x_m, layout.y_m)]
        half_m = [half + MARGIN_M for half in display_m]
        edge_rad = float(np.hypot(half_m[0], half_m[1])) / focal_m
        code_m = 2.0 * focal_m * scanner.rad_per_code
        x_half, y_half = (min(half / code_m, float(CODE_MAX - CENTRE_CODE)) for half in half_m)
        of_axes = {
            "gain_{}": (1.0, 0.01),
            "offset_{}_rad": (0.0, 2e-3),
            "cross_{}": (0.0, 5e-3),
            "cubic_{}_per_rad2": (0.0, 2e-3 / range_rad**2),
            "shift_{}_m": (0.0, 2e-3),
            "tilt_{}_rad": (0.0, 0.015),
        }
        tolerances = {name.format(axis): each for name, each in of_axes.items() for axis in "xy"} | {
            "mirror_distance_m": (14e-3, 4e-3),
            "lens_distance_m": (45e-3, 12e-3),
            "focal_length_m": (focal_m, 0.005 * focal_m),
            "distortion3_per_rad2": (0.0, 3e-3 / edge_rad**2),
            "distortion5_per_rad4": (0.0, 1e-3 / edge_rad**4),
            "turn_rad": (0.0, 0.03),
        }
        return cls(
            mean=FieldGeometry(**{name: mean for name, (mean, _) in tolerances.items()}),
            sigma=np.array([tolerances[name][1] for name in FieldGeometry._fields]),
            rad_per_code=scanner.rad_per_code,
            focal_length_m=focal_m,
            extent=Extent(float(CENTRE_CODE), float(CENTRE_CODE), x_half, y_half),
            display_extent=Extent(float(CENTRE_CODE), float(CENTRE_CODE), display_m[0] / code_m, display_m[1] / code_m),
            field_area_m2=4.0 * half_m[0] * half_m[1],
            display=config.name,
            wiring=scanner.wiring,
        )
