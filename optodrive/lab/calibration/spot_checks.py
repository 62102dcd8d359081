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
from optodrive.lab.calibration.field_prior import Prior
from optodrive.lab.calibration.spots import Spots

LEAST_SPOTS = 6
FLAT = 0.05
"""Spots whose extent in one direction is less than this share of the other lie on a line."""
STILL = 0.02
"""A beam that moves less than this share of what was asked does not move."""
DRAWS = 500
MISS_M = 3e-3
"""A straight map through true spots leaves less than this."""
SCALE_OFF = 0.1
TURN_MAX_RAD = 0.15
SHIFT_MAX_M = 10e-3
UNITS = {"millimetres": 1e3, "centimetres": 1e2, "micrometres": 1e6, "inches": 1 / 0.0254}
AXES = {
    (-1, 0, 0, 1): "x mirrored: x_m falls where x_code rises",
    (1, 0, 0, -1): "y mirrored: y_m falls where y_code rises",
    (-1, 0, 0, -1): "x and y mirrored: a display turned by half a turn",
    (0, 1, 1, 0): "x_m and y_m exchanged: x_m follows y_code, y_m x_code",
    (0, -1, 1, 0): "a quarter turn: x_m falls where y_code rises",
    (0, 1, -1, 0): "a quarter turn: y_m falls where x_code rises",
    (0, -1, -1, 0): "x_m and y_m exchanged and both mirrored",
}
"""The matrix of places by codes, row by row, and what it means."""


def check_spots(where: str, spots: Spots, prior: Prior) -> None:
    """Refuse spots that no field can be fitted to; InputError says why, `where` names the file."""
    if len(spots) < LEAST_SPOTS:
        raise InputError(f"{where}: spots", len(spots), f"at least {LEAST_SPOTS}")
    codes = np.column_stack([spots.x_code, spots.y_code])
    widths = np.linalg.svd(codes - codes.mean(axis=0), compute_uv=False)
    if widths[0] == 0.0:
        raise InputError(
            f"{where}: x_code, y_code", codes[0].tolist(), "several places, all spots were asked for at one"
        )
    if widths[1] < FLAT * widths[0]:
        share = f"all on a line, {widths[1] / widths[0]:.1%} as wide as long"
        raise InputError(f"{where}: x_code, y_code", share, "spots over the whole field")
    asked_m = 2.0 * prior.focal_length_m * prior.rad_per_code * (codes - CENTRE_CODE)
    seen_m = np.column_stack([spots.x_m, spots.y_m])
    _check_it_moves(where, asked_m, seen_m)
    straight, shift, left = _straight(asked_m, seen_m)
    scale = float(np.sqrt(abs(np.linalg.det(straight))))
    if left > MISS_M * max(scale, 1.0):
        found = f"places that leave {left / max(scale, 1.0) * 1e3:.1f} mm to any straight map"
        raise InputError(f"{where}: x_m, y_m", found, "spots most of which are true: nearly all look false")
    _check_scale(where, scale)
    _check_axes(where, straight / scale)
    if float(np.hypot(*shift)) > SHIFT_MAX_M:
        found = f"{shift[0] * 1e3:.1f}, {shift[1] * 1e3:.1f} mm with both mirrors in the middle"
        raise InputError(
            f"{where}: x_m, y_m", found, f"the display's middle within {SHIFT_MAX_M * 1e3:g} mm of the beam"
        )


def check_fit(where: str, fit: FieldFit) -> None:
    """Refuse a fit that takes half of its spots or more for false, or has too few left."""
    false = int(fit.outlier.sum())
    if 2 * false >= len(fit.spots) or len(fit.spots) - false < LEAST_SPOTS:
        found = f"{false} of {len(fit.spots)} spots that no geometry explains"
        raise InputError(f"{where}: x_m, y_m", found, f"most spots true, and {LEAST_SPOTS} of them at least")


def _check_it_moves(where: str, asked_m: FloatArray, seen_m: FloatArray) -> None:
    asked, seen = (np.median(np.abs(places - np.median(places, axis=0)), axis=0) for places in (asked_m, seen_m))
    still = seen < STILL * asked
    moved = f"by {seen[0] * 1e3:.3g}, {seen[1] * 1e3:.3g} mm, asked {asked[0] * 1e3:.3g}, {asked[1] * 1e3:.3g}"
    if np.all(still | (asked == 0.0)):
        raise InputError(f"{where}: x_m, y_m", moved, "a beam that moves: all spots were seen at one place")
    for axis, name in enumerate("xy"):
        if still[axis]:
            raise InputError(f"{where}: {name}_m", moved, f"a beam that moves in {name}: this mirror stands still")


def _straight(asked_m: FloatArray, seen_m: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """The straight map with the least median of what it leaves: [2, 2], shift [2], and what it leaves to half of all.

    Through three spots drawn again and again: false ones among them leave much to the others.
    """
    random = np.random.default_rng(0)
    half = (len(asked_m) + 4) // 2 - 1
    best, chosen = float("inf"), np.zeros((3, 2))
    size = np.ptp(asked_m, axis=0).prod()
    for _ in range(DRAWS):
        three = random.choice(len(asked_m), 3, replace=False)
        matrix = np.column_stack([asked_m[three], np.ones(3)])
        if abs(np.linalg.det(matrix)) < 0.05 * size:
            continue
        map_ = np.asarray(np.linalg.solve(matrix, seen_m[three]), dtype=np.float64)
        scale = max(1e-12, float(np.linalg.norm(map_[:2])))
        left = float(np.partition(np.hypot(*(asked_m @ map_[:2] + map_[2] - seen_m).T), half)[half])
        if left / scale < best:
            best, chosen = left / scale, map_
    return chosen[:2].T, chosen[2], best * max(1e-12, float(np.linalg.norm(chosen[:2])))


def _check_scale(where: str, scale: float) -> None:
    for unit, times in UNITS.items():
        if abs(scale / times - 1.0) < SCALE_OFF:
            raise InputError(f"{where}: x_m, y_m", f"what looks like {unit}", "metres")
    if abs(scale - 1.0) > SCALE_OFF:
        raise InputError(
            f"{where}: x_m, y_m",
            f"distances {scale:.3g} × those asked for",
            f"1 ± {SCALE_OFF:g}; scanner.focal_length_m and range_rad say what is asked for",
        )


def _check_axes(where: str, directions: FloatArray) -> None:
    """directions: [2, 2] without scale."""
    alike = {signs: float(np.array(signs) @ directions.ravel()) / 2.0 for signs in [*AXES, (1, 0, 0, 1)]}
    nearest = max(alike, key=lambda signs: alike[signs])
    if nearest in AXES:
        raise InputError(f"{where}: x_m, y_m", AXES[nearest], "x_m to follow x_code and y_m y_code, both rising")
    turn_rad = float(np.arctan2(directions[1, 0] - directions[0, 1], directions[0, 0] + directions[1, 1]))
    if abs(turn_rad) > TURN_MAX_RAD:
        raise InputError(
            f"{where}: x_m, y_m",
            f"a display turned by {degrees(turn_rad):.1f}°",
            f"{degrees(TURN_MAX_RAD):.0f}° at most",
        )
