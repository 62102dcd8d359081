"""Display metres to mirror angles: what the planner asks of a field, and the ideal one."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import Config, PixelLayout

DERIVATIVE_STEP_M = 1e-4
"""Slopes are taken over so much to either side."""


class ScanField(Protocol):
    """Where to command the mirrors; an ideal field, or a calibrated one."""

    def angles_rad(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Commanded mechanical angles of both mirrors, rad, for places on the display, m; any shape."""
        ...


@dataclass(frozen=True)
class IdealField:
    """x = f · 2 θ: the beam turns by twice the mirror's mechanical angle, and mirrors have no distance between them."""

    focal_length_m: float

    def angles_rad(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mechanical mirror angles, rad, for places on the display, m; any shape."""
        return x_m / (2.0 * self.focal_length_m), y_m / (2.0 * self.focal_length_m)


def max_neighbour_step_rad(layout: PixelLayout, x_rad: FloatArray, y_rad: FloatArray) -> float:
    """The most that either mirror turns from a pixel to one beside it, also diagonally; 0 without neighbours."""
    rows, columns = layout.row.tolist(), layout.column.tolist()
    place = {(row, column): at for at, (row, column) in enumerate(zip(rows, columns, strict=True))}
    pairs = [
        (at, place[row + up, column + right])
        for (row, column), at in place.items()
        for up, right in ((0, 1), (1, 0), (1, 1), (1, -1))
        if (row + up, column + right) in place
    ]
    if not pairs:
        return 0.0
    one, other = np.array(pairs).T
    return float(max(np.abs(angle[one] - angle[other]).max() for angle in (x_rad, y_rad)))


def tolerance_ratio(field: ScanField, layout: PixelLayout, config: Config) -> float:
    """By what share of the nominal tolerance both mirrors may be off at once, anywhere, with the focus on the absorber.

    A beam that is turned by a little more than nominally, or askew, leaves less.
    """
    slopes = []
    for x_step_m, y_step_m in ((DERIVATIVE_STEP_M, 0.0), (0.0, DERIVATIVE_STEP_M)):
        high, low = (
            np.stack(field.angles_rad(layout.x_m + sign * x_step_m, layout.y_m + sign * y_step_m))
            for sign in (1.0, -1.0)
        )
        slopes.append((high - low) / (2.0 * DERIVATIVE_STEP_M))
    metres_per_rad = np.linalg.inv(np.stack(slopes, axis=-1).transpose(1, 0, 2))
    tolerance_rad = np.array(config.tolerance_rad)
    room_m = 2.0 * config.scanner.focal_length_m * tolerance_rad
    return float((room_m / (np.abs(metres_per_rad) @ tolerance_rad)).min())
