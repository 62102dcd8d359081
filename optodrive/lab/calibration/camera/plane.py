"""Where on the display a place in the picture is: a plane in perspective, seen through a lens that bends.

One picture of the grid gives both: bent about a centre by a rational law of the radius, then a homography. Several
give the camera first, by OpenCV; what that leaves in the plane's own picture is fitted the same way.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray, freeze_arrays
from optodrive.lab.calibration.camera.image import opencv

BEND_WIDTHS = (0.03, 0.03, 0.3, 0.3, 0.3)
"""Before anything is measured: the centre, and terms of the radius, both in half diagonals; one sigma."""
CORNER_PX = 0.05
STEPS = 12
NUDGE = 1e-6


@dataclass(frozen=True, eq=False)
class Plane:
    """Picture to display.

    middle_px, half_px: what places are counted from and in; camera: matrix and distortion by OpenCV, None from one view
    middle_m, half_m: the same of the display; values: centre [2], bend [3], homography [8]; covariance: of them
    left_px: rms of what corners of the grid are off on an axis; low_m, high_m: what the grid spans
    """

    middle_px: FloatArray
    half_px: float
    camera: tuple[FloatArray, FloatArray] | None
    middle_m: FloatArray
    half_m: float
    values: FloatArray
    covariance: FloatArray
    left_px: float
    low_m: FloatArray
    high_m: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def places_m(self, at_px: FloatArray) -> FloatArray:
        """Where places in the picture [n, 2] are on the display, m, [n, 2]."""
        return self.middle_m + self.half_m * _mapped(self._straight(at_px), self.values)

    def derivatives_m(self, at_px: FloatArray) -> FloatArray:
        """Metres a pixel at places [n, 2]: [n, 2 of metres, 2 of pixels]."""
        steps = [self.places_m(at_px + 0.5 * step) - self.places_m(at_px - 0.5 * step) for step in np.eye(2)]
        return np.stack(steps, axis=-1)

    def sigma_m(self, at_px: FloatArray) -> FloatArray:
        """How sure the plane itself is at places [n, 2], one sigma on an axis, m, [n]."""
        by_value = _derivatives(self._straight(at_px), self.values)
        variance = np.einsum("nau,uv,nav->n", by_value, self.covariance, by_value) / 2.0
        return np.asarray(self.half_m * np.sqrt(variance), dtype=np.float64)

    def inside(self, places_m: FloatArray, margin_m: float) -> BoolArray:
        """Of places [n, 2], which lie within the grid or no farther from it than margin_m, [n]."""
        within = (places_m > self.low_m - margin_m) & (places_m < self.high_m + margin_m)
        return np.asarray(within.all(axis=1), dtype=np.bool_)

    def _straight(self, at_px: FloatArray) -> FloatArray:
        return (_undistorted(at_px, self.camera) - self.middle_px) / self.half_px


def fit_plane(views_px: list[FloatArray], marks_m: FloatArray, pitch_m: float, size: tuple[int, int]) -> Plane:
    """From the grid in pictures, each [rows, columns, 2] px, the first of them in the display's plane.

    marks_m: where its corners lie there, m, likewise; size: columns and rows of the pictures
    """
    middle_px, half_px = 0.5 * (np.array(size) - 1.0), 0.5 * float(np.hypot(*size))
    camera, camera_left_px = _camera(views_px, pitch_m, size) if len(views_px) > 1 else (None, 0.0)
    seen = (_undistorted(views_px[0].reshape(-1, 2), camera) - middle_px) / half_px
    places_m = marks_m.reshape(-1, 2)
    low_m, high_m = places_m.min(axis=0), places_m.max(axis=0)
    middle_m, half_m = 0.5 * (low_m + high_m), 0.5 * float(np.hypot(*(high_m - low_m)))
    placed = (places_m - middle_m) / half_m
    start = opencv().findHomography(seen, placed, 0)[0]
    values = np.concatenate([np.zeros(5), (start / start[2, 2]).ravel()[:8]])
    values, covariance, left = _fitted(seen, placed, values, half_px)
    return Plane(
        middle_px,
        half_px,
        camera,
        middle_m,
        half_m,
        values,
        covariance,
        max(left * half_px, camera_left_px),
        low_m,
        high_m,
    )


def _fitted(seen: FloatArray, placed: FloatArray, values: FloatArray, half_px: float) -> tuple[Any, Any, float]:
    """Gauss and Newton; noise as found, as on the picture's scale at the grid's middle."""
    widths = np.concatenate([BEND_WIDTHS, np.full(8, np.inf)])
    matrix = np.append(values[5:], 1.0).reshape(3, 3)
    scale = np.sqrt(abs(np.linalg.det(matrix[:2, :2] - np.outer(_mapped(np.zeros((1, 2)), values)[0], matrix[2, :2]))))
    noise = CORNER_PX / half_px * scale
    for _ in range(STEPS):
        by_value = _derivatives(seen, values).reshape(-1, len(values)) / noise
        left = (placed - _mapped(seen, values)).ravel() / noise
        normal = by_value.T @ by_value + np.diag(widths**-2.0)
        values = values + np.linalg.solve(normal, by_value.T @ left - widths**-2.0 * values)
    rms = float(np.sqrt(((placed - _mapped(seen, values)) ** 2).sum() / max(1, 2 * len(seen) - len(values))))
    normal = by_value.T @ by_value * (noise / max(rms, 0.1 * noise)) ** 2 + np.diag(widths**-2.0)
    return values, np.linalg.inv(normal), rms / scale


def _mapped(straight: FloatArray, values: FloatArray) -> FloatArray:
    """[n, 2] of the picture to [n, 2] of the display, both about their middles."""
    from_centre = straight - values[:2]
    square = (from_centre**2).sum(axis=1, keepdims=True)
    bent = from_centre / (1.0 + square * (values[2] + square * (values[3] + square * values[4]))) + values[:2]
    matrix = np.append(values[5:], 1.0).reshape(3, 3)
    through = bent @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(through[:, :2] / through[:, 2:], dtype=np.float64)


def _derivatives(straight: FloatArray, values: FloatArray) -> FloatArray:
    """[n, 2, values]."""
    steps = NUDGE * np.eye(len(values))
    moved = [_mapped(straight, values + step) - _mapped(straight, values - step) for step in steps]
    return np.stack(moved, axis=-1) / (2.0 * NUDGE)


def _camera(
    views_px: list[FloatArray], pitch_m: float, size: tuple[int, int]
) -> tuple[tuple[FloatArray, FloatArray], float]:
    """Matrix [3, 3] and distortion of the camera, from the grid seen from several sides; rms left on an axis, px."""
    rows, columns = views_px[0].shape[:2]
    right, down = np.meshgrid(np.arange(columns), np.arange(rows))
    board = (pitch_m * np.stack([right, down, 0 * right], axis=-1).reshape(-1, 3)).astype(np.float32)
    seen = [view.reshape(-1, 1, 2).astype(np.float32) for view in views_px]
    left_px, matrix, distortion, _, _ = opencv().calibrateCamera([board] * len(seen), seen, size, None, None)
    camera = np.asarray(matrix, dtype=np.float64), np.asarray(distortion, dtype=np.float64)
    return camera, float(left_px) / np.sqrt(2.0)


def _undistorted(at_px: FloatArray, camera: tuple[FloatArray, FloatArray] | None) -> FloatArray:
    """Where a lens that bends nothing would show them, px, [n, 2]."""
    if camera is None or not len(at_px):
        return at_px
    matrix, distortion = camera
    cv2 = opencv()
    ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    points = at_px.reshape(-1, 1, 2)
    straight = cv2.undistortImagePoints(points, matrix, distortion, None, ends)
    return np.asarray(straight, dtype=np.float64).reshape(-1, 2)
