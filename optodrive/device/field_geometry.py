"""The physical part of a field: two mirrors a distance apart, an f-theta lens, a board that lies a little askew.

Closed forms. A mirror at rest stands in the middle of its converter's range; the beam turns by twice its angle.
"""

from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import HALF_RANGE_CODES

CENTRE_CODE = HALF_RANGE_CODES + 1
CODE_MAX = 2 * HALF_RANGE_CODES + 1
DERIVATIVE_STEP = 1e-3
"""Parameters are moved by this share of their prior's width where a derivative is taken."""


class FieldGeometry(NamedTuple):
    """Parameters of the physical part, in the units of their names.

    gain, cross (from the other axis): of 1; cubic_per_rad2: servo, relative; apart_m: mirror x to mirror y; lens_at_m:
    from mirror y; focal_m and bend*: r = focal θ (1 + bend3 θ² + bend5 θ⁴); shift: the board's origin; turn and tilt:
    of the board, about the optical axis, x and y
    """

    gain_x: float
    gain_y: float
    offset_x_rad: float
    offset_y_rad: float
    cross_x: float
    cross_y: float
    cubic_x_per_rad2: float
    cubic_y_per_rad2: float
    mirror_distance_m: float
    lens_distance_m: float
    focal_length_m: float
    distortion3_per_rad2: float
    distortion5_per_rad4: float
    shift_x_m: float
    shift_y_m: float
    turn_rad: float
    tilt_x_rad: float
    tilt_y_rad: float


def beam_position_m(geometry: FieldGeometry, x_rad: FloatArray, y_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where the beam lands on the board, in its own axes, m, for commanded mirror angles, rad; any shape."""
    g = geometry
    standing_x = 2.0 * (g.gain_x * x_rad * (1.0 + g.cubic_x_per_rad2 * x_rad * x_rad) + g.cross_x * y_rad)
    standing_y = 2.0 * (g.gain_y * y_rad * (1.0 + g.cubic_y_per_rad2 * y_rad * y_rad) + g.cross_y * x_rad)
    standing_x += 2.0 * g.offset_x_rad
    standing_y += 2.0 * g.offset_y_rad
    aside_x, along_x = np.sin(standing_x), np.cos(standing_x)
    aside_y, along = along_x * np.sin(standing_y), along_x * np.cos(standing_y)
    # Never zero, and too little to matter: the lens stretches by f on its axis.
    aside = np.sqrt(aside_x * aside_x + aside_y * aside_y + 1e-24)
    bend = np.arctan2(aside, along)
    bend2 = bend * bend
    stretch = (
        g.focal_length_m * (1.0 + bend2 * (g.distortion3_per_rad2 + bend2 * g.distortion5_per_rad4)) * bend / aside
    )
    focus_x, focus_y = stretch * aside_x, stretch * aside_y
    # How far the beam goes sideways on a metre behind the lens, where the board does not lie in the focal plane.
    slope_x = (
        focus_x - g.lens_distance_m * aside_x / along - g.mirror_distance_m * aside_x / along_x
    ) / g.focal_length_m
    slope_y = (focus_y - g.lens_distance_m * aside_y / along) / g.focal_length_m
    (ax, ay, az), (bx, by, bz), (nx, ny, nz) = build_board_axes(g).tolist()
    from_x, from_y = focus_x - g.shift_x_m, focus_y - g.shift_y_m
    height = -(nx * from_x + ny * from_y) / (nz + nx * slope_x + ny * slope_y)
    from_x += height * slope_x
    from_y += height * slope_y
    return ax * from_x + ay * from_y + az * height, bx * from_x + by * from_y + bz * height


def build_board_axes(geometry: FieldGeometry) -> FloatArray:
    """The board's x, y and normal as rows, [3, 3]."""
    turn, tilt_x, tilt_y = geometry.turn_rad, geometry.tilt_x_rad, geometry.tilt_y_rad
    (c, s), (cx, sx), (cy, sy) = ((np.cos(angle), np.sin(angle)) for angle in (turn, tilt_x, tilt_y))
    about_z = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, sx], [0.0, -sx, cx]])
    about_y = np.array([[cy, 0.0, -sy], [0.0, 1.0, 0.0], [sy, 0.0, cy]])
    axes: FloatArray = about_y @ about_x @ about_z
    return axes


def compute_parameter_derivatives(
    geometry: FieldGeometry, widths: FloatArray, x_rad: FloatArray, y_rad: FloatArray
) -> FloatArray:
    """Derivatives of the landing by each parameter in units of `widths`, [2, n, parameters]; by central differences."""
    columns = []
    for index, width in enumerate(widths.tolist()):
        high, low = (
            np.stack(beam_position_m(_perturb(geometry, index, sign * DERIVATIVE_STEP * width), x_rad, y_rad))
            for sign in (1.0, -1.0)
        )
        columns.append((high - low) / (2.0 * DERIVATIVE_STEP))
    return np.stack(columns, axis=-1)


def _perturb(geometry: FieldGeometry, index: int, by: float) -> FieldGeometry:
    return FieldGeometry(*(value + by * (at == index) for at, value in enumerate(geometry)))
