"""Checks of spots before and after a fit, with the probable cause in the error message.

The affine map with the least median of squares relates measured to commanded positions: its scale shows wrong units,
its directions show exchanged or mirrored axes, and its residual shows outliers.
"""

from math import degrees

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.quantity import format_quantity
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.device.config_sections import Wiring
from optodrive.device.field_geometry import CENTRE_CODE
from optodrive.lab.calibration.field_fit import FieldFit, fit_field
from optodrive.lab.calibration.spots import FieldPrior, MeasuredSpots

SPOTS_MIN = 6
"""Smallest number of spots, and of inliers, for a fit."""
COLLINEARITY_RATIO_MIN = 0.05
"""Smallest ratio of the spots' extents in two directions; below it they lie on a line."""
MOTION_RATIO_MIN = 0.02
"""Smallest ratio of measured to commanded motion; below it the beam does not move."""
LMEDS_DRAWS = 500
"""Random samples of three spots for the least median of squares."""
COLUMNS_RATIO_MIN = 15.0
"""Smallest ratio of the two columns' scales for them to be in different units."""
AFFINE_RESIDUAL_MAX_M = 3e-3
"""Largest median residual of an affine map through inliers, m."""
ROW_LAGS = (1, -1)
"""Rows by which positions may stand late or early by mistake."""
DEVIATION_MAX_M = 5e-3
"""Largest distance from an affine map that counts as such, m: it bounds the weight of outliers."""
SCALE_TOLERANCE = 0.1
"""Largest relative deviation of the scale from 1."""
TURN_MAX_RAD = 0.15
"""Largest rotation of the display, rad."""
SHIFT_MAX_M = 10e-3
"""Largest offset of the beam at both centre codes from the display's middle, m."""
UNIT_FACTORS = {"millimetres": 1e3, "centimetres": 1e2, "micrometres": 1e6, "inches": 1 / 0.0254}
"""Units that are mistaken for metres, per metre."""
AXIS_ERRORS = {
    (-1, 0, 0, 1): "x mirrored: x_m decreases as x_code increases",
    (1, 0, 0, -1): "y mirrored: y_m decreases as y_code increases",
    (-1, 0, 0, -1): "x and y mirrored: a display rotated by half a turn",
    (0, 1, 1, 0): "x_m and y_m exchanged: x_m follows y_code, y_m x_code",
    (0, -1, 1, 0): "a quarter turn: x_m decreases as y_code increases",
    (0, 1, -1, 0): "a quarter turn: y_m decreases as x_code increases",
    (0, -1, -1, 0): "x_m and y_m exchanged and both mirrored",
}
"""Wrong axes by the sign pattern of the matrix from commanded to measured positions, row by row."""


def check_spots(where: str, spots: MeasuredSpots, prior: FieldPrior) -> None:
    """Check that a field can be fitted to spots. Raise InputError with the cause.

    where: names the file
    """
    if len(spots) < SPOTS_MIN:
        raise InputError(f"{where}: spots", len(spots), f"at least {SPOTS_MIN}")
    codes = np.column_stack([spots.x_code, spots.y_code])
    widths = np.linalg.svd(codes - codes.mean(axis=0), compute_uv=False)
    if widths[0] == 0.0:
        expected = "several places, but all spots have the same codes"
        raise InputError(f"{where}: x_code, y_code", codes[0].tolist(), expected)
    if widths[1] < COLLINEARITY_RATIO_MIN * widths[0]:
        found = f"all on a line, {widths[1] / widths[0]:.1%} as wide as long"
        raise InputError(f"{where}: x_code, y_code", found, "spots over the whole field")
    commanded_m = 2.0 * prior.focal_length_m * prior.rad_per_code * (codes - CENTRE_CODE)
    measured_m = np.column_stack([spots.x_m, spots.y_m])
    _check_beam_moves(where, commanded_m, measured_m)
    _check_single_columns(where, commanded_m, measured_m)
    matrix, shift, residual_m = _fit_affine(commanded_m, measured_m)
    scale = float(np.sqrt(abs(np.linalg.det(matrix))))
    if residual_m > AFFINE_RESIDUAL_MAX_M * max(scale, 1.0):
        _check_row_lag(where, commanded_m, measured_m)
        found = f"positions {residual_m / max(scale, 1.0) * 1e3:.1f} mm off any affine map"
        raise InputError(f"{where}: x_m, y_m", found, "valid spots for the most part; nearly all look like outliers")
    _check_scale(where, scale)
    _check_axes(where, matrix / scale, prior.wiring)
    if float(np.hypot(*shift)) > SHIFT_MAX_M:
        _check_row_lag(where, commanded_m, measured_m)
        found = f"{shift[0] * 1e3:.1f}, {shift[1] * 1e3:.1f} mm with both mirrors in the middle position"
        expected = f"the display's middle within {format_quantity(SHIFT_MAX_M, 'm')} of the beam"
        raise InputError(f"{where}: x_m, y_m", found, expected)


def check_fit(where: str, fit: FieldFit) -> None:
    """Check a fit. Raise InputError if half of its spots or more are outliers, or too few are inliers.

    Positions that stand one row late of a grid's codes are shifted by one step each, which a field can explain, except
    for those at the ends of the grid's lines: fewer outliers remain when they are moved back.
    """
    outlier_count, table = int(fit.outlier.sum()), fit.spots.to_table()
    for lag in ROW_LAGS if outlier_count > 1 and len(table) > SPOTS_MIN else ():
        moved = np.column_stack([_shift_rows(table[:, :2], lag), _shift_rows(table[:, 2:], -lag)])
        if 2 * fit_field(type(fit.spots).from_table(moved), fit.prior).outlier.sum() < outlier_count:
            raise _lag_error(where, lag)
    if 2 * outlier_count >= len(fit.spots) or len(fit.spots) - outlier_count < SPOTS_MIN:
        found = f"{outlier_count} of {len(fit.spots)} spots are outliers"
        raise InputError(f"{where}: x_m, y_m", found, f"more inliers than outliers, and at least {SPOTS_MIN}")


def _shift_rows(rows: FloatArray, lag: int) -> FloatArray:
    """Return rows without the last ones, for a negative lag without the first ones."""
    return rows[: len(rows) - lag] if lag > 0 else rows[-lag:]


def _check_row_lag(where: str, commanded_m: FloatArray, measured_m: FloatArray) -> None:
    """Raise InputError for positions that an affine map fits better, and at the middle, one row above or below."""
    if len(commanded_m) <= SPOTS_MIN:
        return
    shifted = ((lag, _shift_rows(commanded_m, lag), _shift_rows(measured_m, -lag)) for lag in (0, *ROW_LAGS))
    found = {lag: _mean_deviation_m(commanded, measured) for lag, commanded, measured in shifted}
    best = min(found, key=lambda lag: found[lag][0])
    if best and found[best][1] < SHIFT_MAX_M:
        raise _lag_error(where, best)


def _mean_deviation_m(commanded_m: FloatArray, measured_m: FloatArray) -> tuple[float, float]:
    """Return the mean distance from the affine map, each at most DEVIATION_MAX_M, and the map's shift at the middle."""
    matrix, shift, _ = _fit_affine(commanded_m, measured_m)
    distance_m = np.hypot(*(commanded_m @ matrix.T + shift - measured_m).T)
    return float(np.minimum(distance_m, DEVIATION_MAX_M).mean()), float(np.hypot(*shift))


def _lag_error(where: str, lag: int) -> InputError:
    found = f"positions that belong to the codes one row {'above' if lag > 0 else 'below'}"
    return InputError(f"{where}: x_m, y_m", Unquoted(found), "each position in the row of its codes")


def _measure_spread(places_m: FloatArray) -> FloatArray:
    """Return the median distance of places [n, 2] from their median along both axes, [2]."""
    return np.asarray(np.median(np.abs(places_m - np.median(places_m, axis=0)), axis=0))


def _check_beam_moves(where: str, commanded_m: FloatArray, measured_m: FloatArray) -> None:
    commanded, measured = _measure_spread(commanded_m), _measure_spread(measured_m)
    is_stationary = measured < MOTION_RATIO_MIN * commanded
    (x_mm, y_mm), (x_commanded_mm, y_commanded_mm) = measured * 1e3, commanded * 1e3
    motion = f"by {x_mm:.3g}, {y_mm:.3g} mm, commanded {x_commanded_mm:.3g}, {y_commanded_mm:.3g}"
    if np.all(is_stationary | (commanded == 0.0)):
        raise InputError(f"{where}: x_m, y_m", motion, "a beam that moves; all spots were measured at one place")
    for axis, name in enumerate("xy"):
        if is_stationary[axis]:
            raise InputError(f"{where}: {name}_m", motion, f"a beam that moves in {name}; this mirror does not move")


def _fit_affine(commanded_m: FloatArray, measured_m: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Fit the affine map with the least median of squares: matrix [2, 2], shift [2], and the median residual.

    The map is the best of those through three randomly drawn spots, as draws with an outlier leave large residuals.
    """
    random = np.random.default_rng(0)
    half = (len(commanded_m) + 4) // 2 - 1
    best, chosen = float("inf"), np.zeros((3, 2))
    size = np.ptp(commanded_m, axis=0).prod()
    for _ in range(LMEDS_DRAWS):
        three = random.choice(len(commanded_m), 3, replace=False)
        matrix = np.column_stack([commanded_m[three], np.ones(3)])
        if abs(np.linalg.det(matrix)) < 0.05 * size:
            continue
        affine = np.asarray(np.linalg.solve(matrix, measured_m[three]), dtype=np.float64)
        scale = max(1e-12, float(np.linalg.norm(affine[:2])))
        residual = float(np.partition(np.hypot(*(commanded_m @ affine[:2] + affine[2] - measured_m).T), half)[half])
        if residual / scale < best:
            best, chosen = residual / scale, affine
    return chosen[:2].T, chosen[2], best * max(1e-12, float(np.linalg.norm(chosen[:2])))


def _check_single_columns(where: str, commanded_m: FloatArray, measured_m: FloatArray) -> None:
    """Raise InputError for one column in another unit, beside another one in metres or not."""
    commanded, measured = _measure_spread(commanded_m), _measure_spread(measured_m)
    scales = np.divide(measured, commanded, out=np.ones(2), where=commanded > 0.0)
    row = int(scales.argmax())
    if scales[row] < COLUMNS_RATIO_MIN * scales[1 - row]:
        return
    unit = min(UNIT_FACTORS, key=lambda name: float(abs(np.log(scales[row] / UNIT_FACTORS[name]))))
    raise InputError(f"{where}: {'xy'[row]}_m", f"values that look like {unit}", "metres")


def _check_scale(where: str, scale: float) -> None:
    for unit, factor in UNIT_FACTORS.items():
        if abs(scale / factor - 1.0) < SCALE_TOLERANCE:
            raise InputError(f"{where}: x_m, y_m", f"values that look like {unit}", "metres")
    if abs(scale - 1.0) > SCALE_TOLERANCE:
        expected = f"1 ± {SCALE_TOLERANCE:g}; scanner.focal_length_m and range_rad determine the commanded distances"
        raise InputError(f"{where}: x_m, y_m", f"distances {scale:.3g} × the commanded ones", expected)


def _check_axes(where: str, directions: FloatArray, wiring: Wiring) -> None:
    """Check the orientation of the axes and the rotation.

    directions: [2, 2] without scale, from codes along the axes to positions; wiring: that the spots were made with
    """
    similarity = {signs: float(np.array(signs) @ directions.ravel()) / 2.0 for signs in [*AXIS_ERRORS, (1, 0, 0, 1)]}
    nearest = max(similarity, key=lambda signs: similarity[signs])
    if nearest in AXIS_ERRORS:
        matching = _correct_wiring(np.array(nearest).reshape(2, 2), wiring)
        keys = ", ".join(f"{key} = {str(value).lower()}" for key, value in matching._asdict().items())
        expected = f"x_m that increases with x_code, and y_m with y_code; measure again with [scanner] {keys}"
        raise InputError(f"{where}: x_m, y_m", AXIS_ERRORS[nearest], expected)
    turn_rad = float(np.arctan2(directions[1, 0] - directions[0, 1], directions[0, 0] + directions[1, 1]))
    if abs(turn_rad) > TURN_MAX_RAD:
        found = f"a display turned by {degrees(turn_rad):.1f}°"
        raise InputError(f"{where}: x_m, y_m", found, f"at most {degrees(TURN_MAX_RAD):.0f}°")


def _correct_wiring(directions: IntArray, wiring: Wiring) -> Wiring:
    """Return the wiring with which spots whose directions were [2, 2] under another one lie along the axes.

    Outputs are W · axes, and positions D · axes; with positions in place of axes the outputs are W · D⁻¹ · positions.
    """
    signs = np.where([wiring.invert_x, wiring.invert_y], -1, 1)
    outputs = signs[:, None] * (np.eye(2, dtype=np.int64)[::-1] if wiring.swap_axes else np.eye(2, dtype=np.int64))
    corrected = outputs @ directions.T  # the inverse of a signed permutation
    inverted = corrected.sum(axis=1) < 0
    return Wiring(bool(corrected[0, 0] == 0), bool(inverted[0]), bool(inverted[1]))
