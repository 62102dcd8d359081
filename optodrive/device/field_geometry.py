"""Physical geometry of a scan field in closed form: two mirrors at a distance, an f-theta lens, a tilted display.

The centre of the converter's range is the mirror's zero angle; the beam turns by twice the mechanical angle.
"""

from typing import NamedTuple

import numpy as np

from optodrive.core.plausibility import PlausibleRange
from optodrive.core.types.arrays import FloatArray
from optodrive.device.config_sections import HALF_RANGE_CODES

CENTRE_CODE = HALF_RANGE_CODES + 1
CODE_MAX = 2 * HALF_RANGE_CODES + 1
DERIVATIVE_STEP = 1e-3
"""Step of a parameter for its central difference, in units of its prior's standard deviation."""


class FieldGeometry(NamedTuple):
    """Parameters of the geometry, in the units of their names.

    gain: angle over commanded angle; cross: coupling from the other axis; cubic: relative cubic error of the angle;
    mirror_distance: mirror x to mirror y; lens_distance: mirror y to the lens; focal_length, distortion: radius
    r = f θ (1 + distortion3 θ² + distortion5 θ⁴); shift: origin of the display in the focal plane; turn, tilt:
    rotation of the display about the optical axis, x and y
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


_ANGLE = PlausibleRange(0.0, 0.2, "rad")
GEOMETRY_RANGES = {
    "offset_x_rad": _ANGLE,
    "offset_y_rad": _ANGLE,
    "cubic_x_per_rad2": PlausibleRange(0.0, 1e5, "1/rad²"),
    "cubic_y_per_rad2": PlausibleRange(0.0, 1e5, "1/rad²"),
    "mirror_distance_m": PlausibleRange(0.0, 0.5, "m"),
    "lens_distance_m": PlausibleRange(0.0, 0.5, "m"),
    "focal_length_m": PlausibleRange(5e-3, 3.0, "m"),
    "distortion3_per_rad2": PlausibleRange(0.0, 1e5, "1/rad²"),
    "distortion5_per_rad4": PlausibleRange(0.0, 1e9, "1/rad⁴"),
    "shift_x_m": PlausibleRange(0.0, 0.05, "m"),
    "shift_y_m": PlausibleRange(0.0, 0.05, "m"),
    "turn_rad": PlausibleRange(0.0, 0.5, "rad"),
    "tilt_x_rad": _ANGLE,
    "tilt_y_rad": _ANGLE,
}
"""Plausible ranges of absolute values."""


def beam_position_m(geometry: FieldGeometry, x_rad: FloatArray, y_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the beam's position on the display, in its axes, m, for commanded mirror angles of any shape, rad."""
    g = geometry
    beam_x = 2.0 * (g.gain_x * x_rad * (1.0 + g.cubic_x_per_rad2 * x_rad * x_rad) + g.cross_x * y_rad)
    beam_y = 2.0 * (g.gain_y * y_rad * (1.0 + g.cubic_y_per_rad2 * y_rad * y_rad) + g.cross_y * x_rad)
    beam_x += 2.0 * g.offset_x_rad
    beam_y += 2.0 * g.offset_y_rad
    direction_x, cos_x = np.sin(beam_x), np.cos(beam_x)
    direction_y, axial = cos_x * np.sin(beam_y), cos_x * np.cos(beam_y)
    # The small constant avoids 0/0 on the optical axis, where the limit of the ratio is the focal length.
    radial = np.sqrt(direction_x * direction_x + direction_y * direction_y + 1e-24)
    theta = np.arctan2(radial, axial)
    theta2 = theta * theta
    stretch = (
        g.focal_length_m * (1.0 + theta2 * (g.distortion3_per_rad2 + theta2 * g.distortion5_per_rad4)) * theta / radial
    )
    focus_x, focus_y = stretch * direction_x, stretch * direction_y
    # Slopes of the beam behind the lens; they matter where the display is outside the focal plane.
    slope_x = (
        focus_x - g.lens_distance_m * direction_x / axial - g.mirror_distance_m * direction_x / cos_x
    ) / g.focal_length_m
    slope_y = (focus_y - g.lens_distance_m * direction_y / axial) / g.focal_length_m
    (ax, ay, az), (bx, by, bz), (nx, ny, nz) = build_display_axes(g).tolist()
    from_x, from_y = focus_x - g.shift_x_m, focus_y - g.shift_y_m
    height = -(nx * from_x + ny * from_y) / (nz + nx * slope_x + ny * slope_y)
    from_x += height * slope_x
    from_y += height * slope_y
    return ax * from_x + ay * from_y + az * height, bx * from_x + by * from_y + bz * height


def build_display_axes(geometry: FieldGeometry) -> FloatArray:
    """Return the x axis, the y axis and the normal of the display as rows, [3, 3]."""
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
    """Return the derivatives of the position with respect to each parameter, [2, n, parameters].

    widths: unit of each parameter, its prior's standard deviation
    """
    columns = []
    for index, width in enumerate(widths.tolist()):
        high, low = (
            np.stack(beam_position_m(_perturb(geometry, index, sign * DERIVATIVE_STEP * width), x_rad, y_rad))
            for sign in (1.0, -1.0)
        )
        columns.append((high - low) / (2.0 * DERIVATIVE_STEP))
    return np.stack(columns, axis=-1)


def _perturb(geometry: FieldGeometry, index: int, step: float) -> FieldGeometry:
    return FieldGeometry(*(value + step * (at == index) for at, value in enumerate(geometry)))
