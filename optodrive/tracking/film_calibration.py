"""Calibration of a film, the file film.toml: where a contact lies on the display.

An affine map, fitted by least squares to touches at known pixels, contains the film's place, turn, scale per axis and
side (seen from behind it is mirrored). Four touches or more leave a residual, which tells whether they were at the
pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.files import write_text
from optodrive.core.toml_model import Section, check_format, parse_table, read_toml
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.fingers import FingerPlace
from optodrive.tracking.contacts import Contact, FilmAxes, FilmAxis

FORMAT = "optodrive-film"
VERSION = 1
TOUCHES_MIN = 3
WIDTH_MIN_M = 0.005
"""Smallest root mean square distance of the touched pixels from the line that fits them best."""
RESIDUAL_MAX_M = 2e-3
"""Largest root mean square distance of touches from their pixels, which is half a pitch."""
SCALE_ERROR_MAX = 0.2
"""Largest relative difference from the scale that a film states."""
CORNER_MAX_M = 0.7
"""Largest distance of the film's corners from the display's centre, per axis."""
OUTSIDE_MAX = 0.1
"""How far a contact may lie outside the axes, of their length; the kernel does not clamp values."""
PAD_RADIUS_M = 0.005
"""Radius of a contact; what films report of its size is in units of their own."""

Number = Annotated[float, Field(ge=-2.0 * CORNER_MAX_M, le=2.0 * CORNER_MAX_M)]
Row = tuple[Number, Number, Number]


class _Axis(Section):
    minimum: int
    maximum: int
    per_mm: int


class _FilmFile(Section):
    format: str
    version: int
    name: str
    slots: int
    x: _Axis
    y: _Axis
    touches: int
    residual_m: Annotated[float, Field(ge=0, le=RESIDUAL_MAX_M)]
    x_m: Row
    y_m: Row


@dataclass(frozen=True, eq=False)
class FilmCalibration:
    """Map from a film to the display.

    axes: of the film; matrix: [2, 3], display coordinates in metres from x, y and 1, x and y from 0 to 1 over the
    film's axes; touches: their number; residual_m: root mean square distance of touches from their pixels
    """

    axes: FilmAxes
    matrix: FloatArray
    touches: int
    residual_m: float

    def locate(self, contacts: Sequence[Contact]) -> tuple[FingerPlace, ...]:
        """Return the places of contacts on the display. One outside the film's axes has none."""
        points = normalize(self.axes, np.array([contact[1:] for contact in contacts], dtype=np.float64).reshape(-1, 2))
        places_m: list[tuple[float, float]] = (points @ self.matrix.T).tolist()
        is_on_film = (np.abs(points[:, :2] - 0.5) <= 0.5 + OUTSIDE_MAX).all(axis=1)
        return tuple(
            FingerPlace(contacts[row].number, *places_m[row], PAD_RADIUS_M)
            for row in np.flatnonzero(is_on_film).tolist()
        )


def normalize(axes: FilmAxes, points: FloatArray) -> FloatArray:
    """Return points [n, 2] of a film as [n, 3]: x and y from 0 to 1 over its axes, and 1."""
    lower = np.array([axes.x.minimum, axes.y.minimum])
    span = np.maximum(1, np.array([axes.x.maximum, axes.y.maximum]) - lower)
    return np.column_stack([(points - lower) / span, np.ones(len(points))])


def fit_film(axes: FilmAxes, points: FloatArray, places_m: FloatArray) -> FilmCalibration:
    """Fit the map to touches at points [n, 2] of the film and places [n, 2] of the display.

    Raises InputError for too few touches, for touches on one line, and for touches that were elsewhere.
    """
    if len(points) < TOUCHES_MIN:
        raise InputError("touches", len(points), f"at least {TOUCHES_MIN}")
    width_m = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(places_m))
    if width_m < WIDTH_MIN_M:
        raise InputError("pixels to touch", Unquoted("pixels on one line"), "pixels that span the display")
    normalized = normalize(axes, points)
    solution, _, rank, _ = np.linalg.lstsq(normalized, places_m, rcond=1e-6)
    if rank < normalized.shape[1]:
        raise InputError("touches", Unquoted("touches on one line"), "touches at the stated pixels, in their order")
    matrix = np.asarray(solution.T, dtype=np.float64)
    residual_m = float(np.sqrt(((normalized @ solution - places_m) ** 2).sum(axis=1).mean()))
    if residual_m > RESIDUAL_MAX_M:
        found = f"{1e3 * residual_m:.3g} mm from their pixels (rms)"
        raise InputError(
            "touches", Unquoted(found), f"at most {1e3 * RESIDUAL_MAX_M:g} mm, at the pixels in their order"
        )
    _check_scale(axes, matrix)
    _check_corners("corners of the film", matrix)
    return FilmCalibration(axes, matrix, len(points), residual_m)


def _check_scale(axes: FilmAxes, matrix: FloatArray) -> None:
    """Raise InputError for a scale other than the film's own, if it states one."""
    for column, label, axis in ((0, "x", axes.x), (1, "y", axes.y)):
        fitted_m = float(np.hypot(*matrix[:, column]))
        stated_m = 1e-3 * (axis.maximum - axis.minimum) / axis.per_mm if axis.per_mm > 0 else fitted_m
        if abs(fitted_m - stated_m) > SCALE_ERROR_MAX * stated_m:
            expected = f"{1e3 * stated_m:.4g} mm, which the film states; were the touches at the pixels in their order?"
            raise InputError(f"length of the film's {label} axis", Unquoted(f"{1e3 * fitted_m:.4g} mm"), expected)


def _check_corners(where: str, matrix: FloatArray) -> None:
    """Raise InputError for a film that is larger than any display."""
    corners_m = np.array([[0, 0, 1], [0, 1, 1], [1, 0, 1], [1, 1, 1]]) @ matrix.T
    furthest_m = float(np.abs(corners_m).max())
    if furthest_m > CORNER_MAX_M:
        raise InputError(where, Unquoted(f"a corner {furthest_m:.3g} m from the centre"), f"at most {CORNER_MAX_M:g} m")


def write_film_calibration(path: Path, calibration: FilmCalibration) -> None:
    """Write film.toml atomically."""
    axes, (x_m, y_m) = calibration.axes, calibration.matrix.tolist()
    name = "".join(letter for letter in axes.name if letter.isprintable() and letter not in '"\\')
    lines = [
        f'format = "{FORMAT}"',
        f"version = {VERSION}",
        f'name = "{name}"',
        f"slots = {axes.slots}",
        *(
            f"{key} = {{ minimum = {axis.minimum}, maximum = {axis.maximum}, per_mm = {axis.per_mm} }}"
            for key, axis in (("x", axes.x), ("y", axes.y))
        ),
        f"touches = {calibration.touches}",
        f"residual_m = {calibration.residual_m:.3e}",
        "# metres on the display from x and y, each 0 to 1 over its axis, and 1",
        *(f"{key} = [{', '.join(f'{value:.9e}' for value in row)}]" for key, row in (("x_m", x_m), ("y_m", y_m))),
    ]
    write_text(path, "\n".join(lines) + "\n")


def load_film_calibration(path: Path, axes: FilmAxes) -> FilmCalibration:
    """Load film.toml. Raise InputError if it cannot be read, or belongs to a film with other axes."""
    table = read_toml(path)
    check_format(path, table, FORMAT, VERSION)
    content = parse_table(path, table, _FilmFile)
    x, y = (FilmAxis(axis.minimum, axis.maximum, axis.per_mm) for axis in (content.x, content.y))
    if (x, y) != (axes.x, axes.y):
        found = f"axes of {content.name!r}, {x.minimum} to {x.maximum} and {y.minimum} to {y.maximum}"
        expected = (
            f"those of {axes.name!r}, {axes.x.minimum} to {axes.x.maximum} and {axes.y.minimum} to {axes.y.maximum}"
        )
        raise InputError(str(path), Unquoted(found), expected)
    matrix = np.array([content.x_m, content.y_m])
    _check_corners(str(path), matrix)
    return FilmCalibration(axes, matrix, content.touches, content.residual_m)
