"""A calibrated field: display metres to codes and back, with how sure that is. Needs numpy and nothing else."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from optodrive.core.types.arrays import FloatArray, freeze_arrays
from optodrive.device.field_geometry import CENTRE_CODE, CODE_MAX, FieldGeometry, beam_position_m
from optodrive.device.field_surface import Extent, evaluate_terms

PointMap = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
BLOCK_POINTS = 8192
"""Places worked on at a time: their numbers fit into the cache."""
MAX_ITERATIONS = 8
CODE_TOLERANCE = 1.0
"""Codes are looked for until the last step was shorter: the next would be a hundredth of it at most."""
FOLDOVER_FACTOR = 10.0
"""The beam lands no farther off than so many times what the last step nominally is; else it is another place."""
GUESS_ORDER = 7
GUESS_NODES = 40
OUTSIDE_WEIGHT = 0.01
"""Weight of places outside the extent, where nearly nothing is looked up, for the start."""
GUESS_MARGIN = 1.1
"""The start is good for codes up to so many times the converter's range, and best up to so many times the extent."""


@dataclass(frozen=True, eq=False)
class CalibratedField:
    """Physical geometry and smooth surface; arrays are read-only.

    surface_m: [2, TERMS] coefficients of x and y; rad_per_code, focal_length_m: of the configuration it was made for
    sigma_grid_m: [k, k] one sigma on either axis from edge to edge of the extent, rows by y
    """

    geometry: FieldGeometry
    surface_m: FloatArray
    extent: Extent
    rad_per_code: float
    focal_length_m: float
    sigma_grid_m: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def position_m(self, x_code: ArrayLike, y_code: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Where the beam lands for codes, whole or not, m; any shape."""
        return _apply_blockwise(self._block_position_m, x_code, y_code)

    def codes(self, x_m: ArrayLike, y_m: ArrayLike, extrapolate: bool = False) -> tuple[FloatArray, FloatArray]:
        """Codes, not rounded, that lead the beam to places, m; any shape. NaN where no code of the converter does.

        beyond: also codes that a converter of a larger range would have.
        """
        x_code, y_code = _apply_blockwise(self._solve_codes, x_m, y_m)
        if extrapolate:
            return x_code, y_code
        outside = (np.minimum(x_code, y_code) < 0.0) | (np.maximum(x_code, y_code) > CODE_MAX)
        return np.where(outside, np.nan, x_code), np.where(outside, np.nan, y_code)

    def angles_rad(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Commanded mechanical mirror angles for places, m, nominal scale; any shape, NaN likewise."""
        x_code, y_code = self.codes(x_m, y_m)
        return (x_code - CENTRE_CODE) * self.rad_per_code, (y_code - CENTRE_CODE) * self.rad_per_code

    def sigma_m(self, x_code: ArrayLike, y_code: ArrayLike) -> FloatArray:
        """One sigma of the position on either axis, m; any shape. Infinite outside the extent: nothing is claimed."""
        shares = self.extent.normalise(np.asarray(x_code, dtype=np.float64), np.asarray(y_code, dtype=np.float64))
        last = len(self.sigma_grid_m) - 1
        inside = (np.abs(shares[0]) <= 1.0) & (np.abs(shares[1]) <= 1.0)
        x_at, y_at = (np.where(inside, share + 1.0, 0.0) * 0.5 * last for share in shares)
        column, row = (np.minimum(at.astype(np.int64), last - 1) for at in (x_at, y_at))
        x_part, y_part = x_at - column, y_at - row
        grid = self.sigma_grid_m
        low = grid[row, column] * (1.0 - x_part) + grid[row, column + 1] * x_part
        high = grid[row + 1, column] * (1.0 - x_part) + grid[row + 1, column + 1] * x_part
        return np.asarray(np.where(inside, low * (1.0 - y_part) + high * y_part, np.inf), dtype=np.float64)

    def _block_position_m(self, x_code: FloatArray, y_code: FloatArray) -> tuple[FloatArray, FloatArray]:
        """[n] each."""
        scale = self.rad_per_code
        x_m, y_m = beam_position_m(self.geometry, (x_code - CENTRE_CODE) * scale, (y_code - CENTRE_CODE) * scale)
        more = evaluate_terms(self.extent, x_code, y_code) @ self.surface_m.T
        return x_m + more[:, 0], y_m + more[:, 1]

    def _solve_codes(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """From a polynomial's guess, moved by what the guess makes of the miss until that is nothing. [n] each.

        The guess has nearly the field's slope, so each round is one of Newton's.
        """
        guess = self._guess_codes(x_m, y_m)
        found = guess
        for _ in range(MAX_ITERATIONS):
            at_x_m, at_y_m = self._block_position_m(found[:, 0], found[:, 1])
            step = guess - self._guess_codes(at_x_m, at_y_m)
            found = found + step
            if not np.any(np.abs(step) > CODE_TOLERANCE):
                break
        # Far out the guess folds over: it says the same of another place.
        off_m = np.hypot(at_x_m - x_m, at_y_m - y_m)
        near_m = FOLDOVER_FACTOR * CODE_TOLERANCE * 2.0 * self.focal_length_m * self.rad_per_code
        lost = ~(np.all(np.abs(step) <= CODE_TOLERANCE, axis=1) & (off_m <= near_m))
        found[lost] = np.nan
        return found[:, 0], found[:, 1]

    def _guess_codes(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Codes by the polynomial, [n, 2]."""
        scale_m, coefficients = self._guess_polynomial
        guess: FloatArray = _build_monomials(x_m / scale_m, y_m / scale_m) @ coefficients
        return guess

    @cached_property
    def _guess_polynomial(self) -> tuple[float, FloatArray]:
        """Scale in m and coefficients [powers, 2] of a polynomial from places to codes, over the converter's range."""
        node = np.cos(np.pi * (np.arange(GUESS_NODES) + 0.5) / GUESS_NODES) * GUESS_MARGIN * (CODE_MAX - CENTRE_CODE)
        x_code, y_code = (CENTRE_CODE + axis.ravel() for axis in np.meshgrid(node, node))
        x_m, y_m = self._block_position_m(x_code, y_code)
        scale_m = float(max(np.abs(x_m).max(), np.abs(y_m).max()))
        wanted = np.column_stack([x_code, y_code])
        outside = np.maximum(*np.abs(self.extent.normalise(x_code, y_code))) > GUESS_MARGIN
        weight = np.where(outside, OUTSIDE_WEIGHT, 1.0)[:, None]
        powers = _build_monomials(x_m / scale_m, y_m / scale_m)
        coefficients = np.asarray(np.linalg.lstsq(powers * weight, wanted * weight, rcond=None)[0], dtype=np.float64)
        return scale_m, coefficients


def _build_monomials(x: FloatArray, y: FloatArray) -> FloatArray:
    """Monomials of total degree up to START_ORDER, [n, powers]."""
    out = np.empty((len(x), (GUESS_ORDER + 1) * (GUESS_ORDER + 2) // 2), order="F")
    out[:, 0] = 1.0
    at = 0
    for degree in range(1, GUESS_ORDER + 1):
        before, at = at, at + degree
        for index in range(degree):
            np.multiply(out[:, before + index], x, out=out[:, at + index])
        np.multiply(out[:, before + degree - 1], y, out=out[:, at + degree])
    return out


def _apply_blockwise(function: PointMap, first: ArrayLike, second: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Apply a function of two flat arrays to blocks of two arrays of any shape."""
    one, two = np.broadcast_arrays(np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64))
    shape = one.shape
    one, two = one.ravel(), two.ravel()
    out = np.empty((2, len(one)))
    for start in range(0, len(one), BLOCK_POINTS):
        part = slice(start, start + BLOCK_POINTS)
        out[0, part], out[1, part] = function(one[part], two[part])
    return out[0].reshape(shape), out[1].reshape(shape)
