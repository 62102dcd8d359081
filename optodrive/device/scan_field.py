"""Scan fields: display positions to mirror angles, and the ideal field."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.device.config import Config, PixelLayout

DERIVATIVE_STEP_M = 1e-4
"""Half width of the central differences for slopes of the field."""


class ScanField(Protocol):
    """Map from display positions to mirror angles, ideal or calibrated."""

    def angles_rad(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the commanded mechanical angles of both mirrors, rad, for display positions of any shape, m."""
        ...


@dataclass(frozen=True)
class IdealField:
    """Ideal f-theta lens, x = f · 2θ with θ the mechanical mirror angle, and mirrors without distance between them."""

    focal_length_m: float

    def angles_rad(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the mechanical mirror angles, rad, for display positions of any shape, m."""
        return x_m / (2.0 * self.focal_length_m), y_m / (2.0 * self.focal_length_m)


def list_adjacent_pixels(layout: PixelLayout) -> IntArray:
    """Return the pairs of adjacent pixels, diagonals included, [2, n]."""
    rows, columns = layout.row.tolist(), layout.column.tolist()
    place = {(row, column): at for at, (row, column) in enumerate(zip(rows, columns, strict=True))}
    pairs = [
        (at, place[row + up, column + right])
        for (row, column), at in place.items()
        for up, right in ((0, 1), (1, 0), (1, 1), (1, -1))
        if (row + up, column + right) in place
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2).T


def max_neighbour_step_rad(layout: PixelLayout, x_rad: FloatArray, y_rad: FloatArray) -> float:
    """Return the largest angle of either mirror between adjacent pixels, diagonals included, 0 without neighbours."""
    one, other = list_adjacent_pixels(layout)
    if not len(one):
        return 0.0
    return float(max(np.abs(angle[one] - angle[other]).max() for angle in (x_rad, y_rad)))


def tolerance_ratio(field: ScanField, layout: PixelLayout, config: Config) -> float:
    """Return the usable fraction of the nominal angle tolerance, for both mirrors at once and on every pixel.

    It is below 1 where the field's slopes exceed those of the ideal lens or couple the axes.
    """
    slopes = []
    for x_step_m, y_step_m in ((DERIVATIVE_STEP_M, 0.0), (0.0, DERIVATIVE_STEP_M)):
        high, low = (
            np.stack(field.angles_rad(layout.x_m + sign * x_step_m, layout.y_m + sign * y_step_m))
            for sign in (1.0, -1.0)
        )
        slopes.append((high - low) / (2.0 * DERIVATIVE_STEP_M))
    # Axes may be coupled: an error of one mirror then moves the beam along both.
    metres_per_rad = np.linalg.inv(np.stack(slopes, axis=-1).transpose(1, 0, 2))
    tolerance_rad = np.array(config.tolerance_rad)
    tolerance_m = 2.0 * config.scanner.focal_length_m * tolerance_rad
    return float((tolerance_m / (np.abs(metres_per_rad) @ tolerance_rad)).min())
