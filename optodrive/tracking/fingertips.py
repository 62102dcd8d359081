"""Fingertips in pictures of a display: the round ends of shapes that differ from the background.

Each picture is mapped to the display's plane, so that lengths are those of fingers. A shape is a region whose
brightness differs from the background by more than a shadow does, brighter or darker: seen from below, hands are dark.
A fingertip is a place of its contour where the arcs of ARC_M to both sides enclose a sharp angle (Malik and Laszlo,
Visual Touchpad, 2004, section 3.3), and whose end fits a circle as wide as a finger. Its centre is the pad's.
"""

from typing import Any

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.tracking.marks import View, import_opencv

PIXEL_M = 5e-4
"""Size of a pixel of the mapped picture."""
MARGIN_M = 0.02
"""Width of the border around the marks in which a hand is seen, and a fingertip is not reported."""
DIFFERENCE_MIN, COUNTS_MIN = 0.3, 12.0
"""Difference from the background, of its brightness and in counts, that makes a shape; soft shadows have less."""
GAIN_MIN = 0.1
FILL_M, SPOT_MAX_M = 2.5e-3, 5e-3
"""Width of the gaps in a shape that are filled, as of dots as bright as a hand, and of spots that are none."""
AREA_MIN_M2 = 1.5e-4
STEP_M, ARC_M, END_ARC_M = 1e-3, 0.011, 0.009
ANGLE_MAX_RAD = 2.0
RADIUS_MIN_M, RADIUS_MAX_M = 4e-3, 0.011
MARK_SIDES = 1.2
"""Distance from a mark, in its sides, within which its black and white cut shapes."""
EDGE_M = 4e-3
"""Distance from the edge of what the camera sees, at which a shape is cut."""


class FingertipDetector:
    """Finds fingertips in grey pictures of one view.

    pictures: [n, rows, columns] of the display without hands, whose median is the background
    """

    def __init__(self, view: View, pictures: Any) -> None:
        self._cv2 = import_opencv()
        lower_m, upper_m = view.marks_m.min(axis=0), view.marks_m.max(axis=0)
        self._first_m = lower_m - MARGIN_M
        columns, rows = np.ceil((upper_m - lower_m + 2.0 * MARGIN_M) / PIXEL_M).astype(int).tolist()
        self._size = (columns, rows)
        to_display = np.array([[PIXEL_M, 0.0, self._first_m[0]], [0.0, PIXEL_M, self._first_m[1]], [0.0, 0.0, 1.0]])
        self._to_picture = view.homography @ to_display
        self._background = np.maximum(1.0, np.median([self._map(picture) for picture in pictures], axis=0))
        self._seen = self._warp(np.full_like(pictures[0], 255)) == 255
        self._is_free = self._find_free_places(view, lower_m, upper_m)

    def find(self, picture: Any) -> FloatArray:
        """Return the centres of the pads of fingertips on the display, [n, 2]."""
        cv2 = self._cv2
        shapes = self._find_shapes(self._map(picture))
        contours, _ = cv2.findContours(shapes, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        centres_m = [
            centre_m
            for contour in contours
            if PIXEL_M**2 * cv2.contourArea(contour) >= AREA_MIN_M2
            for centre_m in self._find_ends(PIXEL_M * contour.reshape(-1, 2).astype(np.float64))
        ]
        places_m: FloatArray = np.array(centres_m).reshape(-1, 2) + self._first_m
        return places_m

    def _find_free_places(self, view: View, lower_m: FloatArray, upper_m: FloatArray) -> Any:
        """Return where the end of a shape is a fingertip: between the marks, uncut by the edge or a mark."""
        framed = np.pad(self._seen, 1).astype(np.uint8)
        edge_m = PIXEL_M * self._cv2.distanceTransform(framed, self._cv2.DIST_L2, 5)[1:-1, 1:-1]
        rows, columns = np.indices(edge_m.shape)
        places_m = np.stack([columns, rows], axis=-1) * PIXEL_M + self._first_m
        is_free = (edge_m >= EDGE_M) & ((places_m >= lower_m) & (places_m <= upper_m)).all(axis=-1)
        for mark_m in view.marks_m:
            is_free &= np.hypot(*np.moveaxis(places_m - mark_m, -1, 0)) > MARK_SIDES * view.side_m
        return is_free

    def _warp(self, picture: Any) -> Any:
        flags = self._cv2.INTER_LINEAR | self._cv2.WARP_INVERSE_MAP
        return self._cv2.warpPerspective(picture, self._to_picture, self._size, flags=flags)

    def _map(self, picture: Any) -> FloatArray:
        """Map a picture to the display's plane, smoothed."""
        mapped: FloatArray = self._cv2.GaussianBlur(self._warp(picture).astype(np.float32), (0, 0), 1.0)
        return mapped

    def _find_shapes(self, mapped: FloatArray) -> Any:
        """Return where a picture differs from the background, as one byte per pixel."""
        cv2 = self._cv2
        # Exposure and lamps change: a display is covered by hands to less than a half.
        gain = max(GAIN_MIN, float(np.median((mapped / self._background)[self._seen])))
        background = gain * self._background
        differs = np.abs(mapped - background) > DIFFERENCE_MIN * background + COUNTS_MIN
        shapes = (differs & self._seen).astype(np.uint8)
        shapes = cv2.morphologyEx(shapes, cv2.MORPH_CLOSE, self._build_disc(FILL_M))
        return cv2.morphologyEx(shapes, cv2.MORPH_OPEN, self._build_disc(SPOT_MAX_M))

    def _build_disc(self, diameter_m: float) -> Any:
        width = 2 * round(0.5 * diameter_m / PIXEL_M) + 1
        return self._cv2.getStructuringElement(self._cv2.MORPH_ELLIPSE, (width, width))

    def _find_ends(self, contour_m: FloatArray) -> list[FloatArray]:
        """Return the centres of the round ends of a contour [n, 2]."""
        points_m = _resample(contour_m)
        arc, end_arc = round(ARC_M / STEP_M), round(END_ARC_M / STEP_M)
        if len(points_m) < 3 * arc:
            return []
        before, after = np.roll(points_m, arc, axis=0) - points_m, np.roll(points_m, -arc, axis=0) - points_m
        cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
        angle_rad = np.arctan2(np.abs(cross), (before * after).sum(axis=1))
        area_m2 = np.sum(points_m[:, 0] * np.roll(points_m[:, 1], -1) - np.roll(points_m[:, 0], -1) * points_m[:, 1])
        angle_rad[cross * area_m2 > 0.0] = np.pi  # between two fingers
        nearby = np.stack([np.roll(angle_rad, shift) for shift in range(-arc, arc + 1)])
        ends = np.flatnonzero((angle_rad <= nearby.min(axis=0)) & (angle_rad <= ANGLE_MAX_RAD))
        centres_m = []
        for at in ends.tolist():
            column, row = (points_m[at] / PIXEL_M).astype(int)
            if not self._is_free[row, column]:
                continue
            centre_m, radius_m = _fit_circle(points_m[np.arange(at - end_arc, at + end_arc + 1) % len(points_m)])
            if RADIUS_MIN_M <= radius_m <= RADIUS_MAX_M:
                centres_m.append(centre_m)
        return centres_m


def _resample(contour_m: FloatArray) -> FloatArray:
    """Return points of a closed contour at distances of STEP_M along it, smoothed."""
    closed = np.vstack([contour_m, contour_m[:1]])
    length_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    at_m = np.arange(0.0, length_m[-1], STEP_M)
    points_m = np.column_stack([np.interp(at_m, length_m, closed[:, axis]) for axis in (0, 1)])
    return np.asarray(sum(np.roll(points_m, shift, axis=0) for shift in (-1, 0, 1)) / 3.0, dtype=np.float64)


def _fit_circle(points_m: FloatArray) -> tuple[FloatArray, float]:
    """Fit a circle to points [n, 2] by linear least squares. Return its centre and radius."""
    middle_m = points_m.mean(axis=0)
    around_m = points_m - middle_m
    matrix = np.column_stack([2.0 * around_m, np.ones(len(around_m))])
    x_m, y_m, rest_m2 = np.linalg.lstsq(matrix, (around_m**2).sum(axis=1), rcond=None)[0].tolist()
    return middle_m + np.array([x_m, y_m]), float(np.sqrt(max(0.0, rest_m2 + x_m**2 + y_m**2)))
