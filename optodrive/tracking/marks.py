"""Marks at the corners of a display, the file marks.toml, and the map from a camera's picture to the display by them.

The marks are ArUco markers of the dictionary DICT_4X4_50. Four centres define the homography between the picture and
the display's plane. It then has to map each mark to a square of the stated side, which tells of exchanged marks and of
places that are wrong.
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
