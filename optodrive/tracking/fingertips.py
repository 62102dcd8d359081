"""Fingertips in pictures of a display: the round ends of shapes that differ from the background.

Each picture is mapped to the display's plane, so that lengths are those of fingers. A shape is a region whose
brightness differs from the background by more than a shadow does, brighter or darker: seen from below, hands are dark.
A fingertip is a place of its contour where the arcs of ARC_M to both sides enclose a sharp angle (Malik and Laszlo,
Visual Touchpad, 2004, section 3.3), and whose end fits a circle as wide as a finger. Its centre is the pad's.
"""

from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.extras import import_extra
from optodrive.core.plausibility import PlausibleRange
from optodrive.core.toml_model import Section, check_format, parse_table, read_toml
from optodrive.core.types.arrays import FloatArray

FORMAT = "optodrive-marks"
VERSION = 1
MARKS_MIN, MARKS_MAX = 4, 50
SIDE_ERROR_MAX = 0.15
"""Largest relative difference of a mark's side from the stated one, which oblique views and small marks reach half."""
WIDTH_MIN_M = 0.02
"""Smallest root mean square distance of marks from the line that fits them best."""


class Mark(Section):
    """One mark."""

    id: Annotated[int, Field(ge=0, lt=50)]
    """Number of the marker in its dictionary."""
    x_m: Annotated[float, Field(ge=-0.7, le=0.7), PlausibleRange(0.0, 0.7, "m")]
    """Place of its centre on the display."""
    y_m: Annotated[float, Field(ge=-0.7, le=0.7), PlausibleRange(0.0, 0.7, "m")]
    """Place of its centre on the display."""


class MarksFile(Section):
    """The marks of a display."""

    format: str
    """Name of the format."""
    version: int
    """Version of the format."""
    side_m: Annotated[float, Field(ge=0.003, le=0.1), PlausibleRange(0.003, 0.1, "m")]
    """Side of the black square of every mark."""
    marks: Annotated[tuple[Mark, ...], Field(min_length=MARKS_MIN, max_length=MARKS_MAX)]
    """The marks."""


class View(NamedTuple):
    """The display as a camera sees it.

    homography: [3, 3], from display coordinates in metres to the picture in pixels; marks_m: [n, 2], places of all
    marks; side_m: of a mark
    """

    homography: FloatArray
    marks_m: FloatArray
    side_m: float


def import_opencv() -> Any:
    """Import OpenCV. Raise InputError (missing_extra) if it is not installed."""
    return import_extra("cv2", "OpenCV", "tracking")


def load_marks(path: Path) -> MarksFile:
    """Load marks.toml. Raise InputError for one that cannot be read, and for marks that define no plane."""
    table = read_toml(path)
    check_format(path, table, FORMAT, VERSION)
    content = parse_table(path, table, MarksFile)
    ids = [mark.id for mark in content.marks]
    if len(set(ids)) < len(ids):
        raise InputError(f"{path}: marks", ids, "each id once")
    places_m = np.array([(mark.x_m, mark.y_m) for mark in content.marks])
    width_m = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(places_m))
    if width_m < WIDTH_MIN_M:
        raise InputError(f"{path}: marks", Unquoted("marks on one line"), "marks at the display's corners")
    return content


def find_view(picture: Any, marks: MarksFile, where: str) -> View:
    """Find the marks in a grey picture. Raise InputError if four are not there, or are not squares of their side.

    where: name of the picture's source
    """
    cv2 = import_opencv()
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), parameters)
    found, ids, _ = detector.detectMarkers(picture)
    corners_of = {} if ids is None else dict(zip(ids.ravel().tolist(), (c.reshape(4, 2) for c in found), strict=True))
    seen = [mark for mark in marks.marks if mark.id in corners_of]
    if len(seen) < MARKS_MIN:
        shown = ", ".join(str(mark.id) for mark in seen) or "none"
        expected = f"{MARKS_MIN} of the marks {', '.join(str(mark.id) for mark in marks.marks)} in a picture"
        raise InputError(f"{where}: marks", Unquoted(shown), expected, "marks_missing")
    places_m = np.array([(mark.x_m, mark.y_m) for mark in seen])
    centres_px = np.array([_intersect_diagonals(corners_of[mark.id].astype(np.float64)) for mark in seen])
    homography = cv2.findHomography(places_m, centres_px, 0)[0]
    if homography is None or not np.isfinite(homography).all() or abs(np.linalg.det(homography)) < 1e-12:
        raise InputError(f"{where}: marks", Unquoted("marks on one line"), "marks at the display's corners")
    for mark in seen:
        corners_m = project(np.linalg.inv(homography), corners_of[mark.id])
        sides_m = np.hypot(*(np.roll(corners_m, -1, axis=0) - corners_m).T)
        if np.abs(sides_m / marks.side_m - 1.0).max() > SIDE_ERROR_MAX:
            shown = ", ".join(f"{1e3 * side_m:.3g}" for side_m in sides_m)
            expected = f"{1e3 * marks.side_m:g} mm each; are the marks where marks.toml places them?"
            raise InputError(f"{where}: sides of mark {mark.id}", Unquoted(f"{shown} mm"), expected)
    all_m = np.array([(mark.x_m, mark.y_m) for mark in marks.marks])
    return View(np.asarray(homography), all_m, marks.side_m)


def project(homography: FloatArray, points: FloatArray) -> FloatArray:
    """Map points [n, 2] by a homography."""
    projected = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return np.asarray(projected[:, :2] / projected[:, 2:], dtype=np.float64)


def _intersect_diagonals(corners: FloatArray) -> FloatArray:
    """Return where the diagonals of a quadrangle [4, 2] meet, the centre of a square in perspective."""
    first, second = corners[2] - corners[0], corners[3] - corners[1]
    share = np.linalg.solve(np.column_stack([first, -second]), corners[1] - corners[0])[0]
    return np.asarray(corners[0] + share * first, dtype=np.float64)


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
