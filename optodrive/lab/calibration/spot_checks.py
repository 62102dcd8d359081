"""What is wrong with spots before a field is fitted to them, named as what it is.

Measured places are held against nominal ones by the straight map that explains most of them: its scale shows units,
its directions exchanged or mirrored axes, what it does not explain false detections.
"""

from math import degrees

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.device.field_geometry import CENTRE_CODE
from optodrive.lab.calibration.field_fit import FieldFit
from optodrive.lab.calibration.field_prior import FieldPrior
from optodrive.lab.calibration.spots import MeasuredSpots

SPOTS_MIN = 6
COLLINEARITY_RATIO_MIN = 0.05
"""Spots whose extent in one direction is less than this share of the other lie on a line."""
MOTION_RATIO_MIN = 0.02
"""A beam that moves less than this share of what was asked does not move."""
LMEDS_DRAWS = 500
AFFINE_RESIDUAL_MAX_M = 3e-3
"""A straight map through true spots leaves less than this."""
SCALE_TOLERANCE = 0.1
TURN_MAX_RAD = 0.15
SHIFT_MAX_M = 10e-3
UNIT_FACTORS = {"millimetres": 1e3, "centimetres": 1e2, "micrometres": 1e6, "inches": 1 / 0.0254}
AXIS_ERRORS = {
    (-1, 0, 0, 1): "x mirrored: x_m falls where x_code rises",
    (1, 0, 0, -1): "y mirrored: y_m falls where y_code rises",
    (-1, 0, 0, -1): "x and y mirrored: a display turned by half a turn",
    (0, 1, 1, 0): "x_m and y_m exchanged: x_m follows y_code, y_m x_code",
    (0, -1, 1, 0): "a quarter turn: x_m falls where y_code rises",
    (0, 1, -1, 0): "a quarter turn: y_m falls where x_code rises",
    (0, -1, -1, 0): "x_m and y_m exchanged and both mirrored",
}
"""The matrix of places by codes, row by row, and what it means."""


def check_spots(where: str, spots: MeasuredSpots, prior: FieldPrior) -> None:
    """Refuse spots that no field can be fitted to; InputError says why, `where` names the file."""
    if len(spots) < SPOTS_MIN:
        raise InputError(f"{where}: spots", len(spots), f"at least {SPOTS_MIN}")
    codes = np.column_stack([spots.x_code, spots.y_code])
    widths = np.linalg.svd(codes - codes.mean(axis=0), compute_uv=False)
    if widths[0] == 0.0:
        raise InputError(
            f"{where}: x_code, y_code", codes[0].tolist(), "several places, all spots were asked for at one"
        )
    if widths[1] < COLLINEARITY_RATIO_MIN * widths[0]:
        share = f"all on a line, {widths[1] / widths[0]:.1%} as wide as long"
        raise InputError(f"{where}: x_code, y_code", share, "spots over the whole field")
    commanded_m = 2.0 * prior.focal_length_m * prior.rad_per_code * (codes - CENTRE_CODE)
    measured_m = np.column_stack([spots.x_m, spots.y_m])
    _check_beam_moves(where, commanded_m, measured_m)
    matrix, shift, residual_m = _fit_affine(commanded_m, measured_m)
    scale = float(np.sqrt(abs(np.linalg.det(matrix))))
    if residual_m > AFFINE_RESIDUAL_MAX_M * max(scale, 1.0):
        found = f"places that leave {residual_m / max(scale, 1.0) * 1e3:.1f} mm to any straight map"
        raise InputError(f"{where}: x_m, y_m", found, "spots most of which are true: nearly all look false")
    _check_scale(where, scale)
    _check_axes(where, matrix / scale)
    if float(np.hypot(*shift)) > SHIFT_MAX_M:
        found = f"{shift[0] * 1e3:.1f}, {shift[1] * 1e3:.1f} mm with both mirrors in the middle"
        raise InputError(
            f"{where}: x_m, y_m", found, f"the display's middle within {SHIFT_MAX_M * 1e3:g} mm of the beam"
        )


def check_fit(where: str, fit: FieldFit) -> None:
    """Refuse a fit that takes half of its spots or more for false, or has too few left."""
    outlier_count = int(fit.outlier.sum())
    if 2 * outlier_count >= len(fit.spots) or len(fit.spots) - outlier_count < SPOTS_MIN:
        found = f"{outlier_count} of {len(fit.spots)} spots that no geometry explains"
        raise InputError(f"{where}: x_m, y_m", found, f"most spots true, and {SPOTS_MIN} of them at least")


def _check_beam_moves(where: str, commanded_m: FloatArray, measured_m: FloatArray) -> None:
    commanded, measured = (
        np.median(np.abs(places - np.median(places, axis=0)), axis=0) for places in (commanded_m, measured_m)
    )
    is_stationary = measured < MOTION_RATIO_MIN * commanded
    (x_mm, y_mm), (x_commanded_mm, y_commanded_mm) = measured * 1e3, commanded * 1e3
    motion = f"by {x_mm:.3g}, {y_mm:.3g} mm, commanded {x_commanded_mm:.3g}, {y_commanded_mm:.3g}"
    if np.all(is_stationary | (commanded == 0.0)):
        raise InputError(f"{where}: x_m, y_m", motion, "a beam that moves: all spots were seen at one place")
    for axis, name in enumerate("xy"):
        if is_stationary[axis]:
            raise InputError(f"{where}: {name}_m", motion, f"a beam that moves in {name}: this mirror stands still")


def _fit_affine(commanded_m: FloatArray, measured_m: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """The straight map with the least median of what it leaves: [2, 2], shift [2], and what it leaves to half of all.

    Through three spots drawn again and again: false ones among them leave much to the others.
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


def _check_scale(where: str, scale: float) -> None:
    for unit, factor in UNIT_FACTORS.items():
        if abs(scale / factor - 1.0) < SCALE_TOLERANCE:
            raise InputError(f"{where}: x_m, y_m", f"what looks like {unit}", "metres")
    if abs(scale - 1.0) > SCALE_TOLERANCE:
        raise InputError(
            f"{where}: x_m, y_m",
            f"distances {scale:.3g} × those asked for",
            f"1 ± {SCALE_TOLERANCE:g}; scanner.focal_length_m and range_rad say what is asked for",
        )


def _check_axes(where: str, directions: FloatArray) -> None:
    """directions: [2, 2] without scale."""
    similarity = {signs: float(np.array(signs) @ directions.ravel()) / 2.0 for signs in [*AXIS_ERRORS, (1, 0, 0, 1)]}
    nearest = max(similarity, key=lambda signs: similarity[signs])
    if nearest in AXIS_ERRORS:
        raise InputError(f"{where}: x_m, y_m", AXIS_ERRORS[nearest], "x_m to follow x_code and y_m y_code, both rising")
    turn_rad = float(np.arctan2(directions[1, 0] - directions[0, 1], directions[0, 0] + directions[1, 1]))
    if abs(turn_rad) > TURN_MAX_RAD:
        raise InputError(
            f"{where}: x_m, y_m",
            f"a display turned by {degrees(turn_rad):.1f}°",
            f"{degrees(TURN_MAX_RAD):.0f}° at most",
        )
