"""Detection of a grid's corners or dots in a picture, with subpixel accuracy and in row order."""

from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.calibration.camera.folder import GridSection, OriginSection
from optodrive.lab.calibration.camera.image import Image, import_opencv

FALLBACK_CORNERS_PER_SIDE = 4
"""Corners per side of the smaller grid that is searched for if the whole grid is not found."""
MARK_TOLERANCE = 0.5
"""Largest distance of a mark from its corner, as a fraction of the shortest side between marked corners."""


def find_grid(path: Path, image: Image, grid: GridSection) -> FloatArray:
    """Find the grid's positions in the picture, px, [rows, columns, 2]. The first corner is ambiguous.

    Raises InputError with the picture.
    """
    grey = _to_eight_bits(image)
    found = _find_chessboard(path, grey, grid) if grid.kind == "chessboard" else _find_circles(path, grey, grid)
    return found.reshape(grid.rows, grid.columns, 2).astype(np.float64)


def orient_to_marks(where: str, found: FloatArray, origin: OriginSection) -> FloatArray:
    """Return the same grid with the corner at the first mark first.

    Raises InputError if a mark is not near a corner or the picture is mirrored.
    """
    marks = np.array(origin.marks_px)
    corners = np.stack([found[0, 0], found[0, -1], found[-1, -1], found[-1, 0]])
    nearest = [int(np.argmin(np.hypot(*(corners - mark).T))) for mark in marks]
    shortest_side_px = min(float(np.hypot(*(corners[at] - corners[at - 1]))) for at in range(4))
    for mark, at in zip(marks, nearest, strict=True):
        if np.hypot(*(corners[at] - mark)) > MARK_TOLERANCE * shortest_side_px:
            listed = ", ".join(f"{x:.0f} {y:.0f}" for x, y in corners)
            raise InputError(f"{where}: origin.marks_px", mark.tolist(), f"near one of the grid's corners: {listed}")
    _, right, down = nearest
    along_row, across = (np.subtract(marks[at], marks[0]) for at in (1, 2))
    if len(set(nearest)) < 3 or (right - down) % 4 != 2:
        expected = "three corners of the grid: the first, the last of the first row, the last of the first column"
        raise InputError(f"{where}: origin.marks_px", marks.tolist(), expected)
    if along_row[0] * across[1] - along_row[1] * across[0] < 0.0:
        raise InputError(
            f"{where}: origin.marks_px",
            "a grid that is mirrored in the picture",
            "rows to the right and columns down, seen from the front: the picture is flipped or marks are exchanged",
        )
    # The detection may return any of eight orders.
    for flipped in (found, found[::-1], found[:, ::-1], found[::-1, ::-1]):
        for order in (flipped, flipped.transpose(1, 0, 2)):
            ends = order[0, 0], order[0, -1], order[-1, 0]
            if all(np.array_equal(end, corners[at]) for end, at in zip(ends, nearest, strict=True)):
                if order.shape == found.shape:
                    return order
                counts = f"a first row of {order.shape[1]} and {order.shape[0]} rows"
                raise InputError(f"{where}: origin.marks_px", counts, f"{found.shape[1]} and {found.shape[0]} rows")
    raise AssertionError("three corners have an order")


def grid_corners_m(grid: GridSection, origin: OriginSection) -> FloatArray:
    """Return the corners' positions on the display, m, [rows, columns, 2].

    Rows run to the right and columns down before the rotation by turn_rad.
    """
    right, down = np.meshgrid(np.arange(grid.columns), np.arange(grid.rows))
    along = grid.pitch_m * np.stack([right, -down], axis=-1)
    cos, sin = np.cos(origin.turn_rad), np.sin(origin.turn_rad)
    placed: FloatArray = along @ np.array([[cos, sin], [-sin, cos]]) + np.array(origin.first_corner_m)
    return placed


def _to_eight_bits(image: Image) -> Any:
    if image.dtype == np.uint8:
        return image
    return np.clip(image * (255.0 / max(1.0, float(image.max()))), 0, 255).astype(np.uint8)


def _find_chessboard(path: Path, grey: Any, grid: GridSection) -> FloatArray:
    cv2 = import_opencv()
    # Accept larger grids; otherwise a part of a larger grid would be taken for the whole.
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_LARGER
    size = (grid.columns, grid.rows)
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, size, flags)
    if not found:
        fallback_size = (min(FALLBACK_CORNERS_PER_SIDE, grid.columns), min(FALLBACK_CORNERS_PER_SIDE, grid.rows))
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, fallback_size, flags)
    if not found:
        raise _not_found_error(path, grid)
    places = np.asarray(corners).reshape(*meta.shape, 2)
    if (meta.shape[0] < meta.shape[1]) != (grid.rows < grid.columns):
        places = places.transpose(1, 0, 2)  # the direction of rows is ambiguous as well
    rows, columns = places.shape[:2]
    if (rows, columns) != (grid.rows, grid.columns):
        raise InputError(
            f"{path}: corners",
            f"{rows} × {columns}",
            f"{grid.rows} rows × {grid.columns} columns: inner corners, one fewer than squares, all of them visible",
        )
    return places


def _find_circles(path: Path, grey: Any, grid: GridSection) -> FloatArray:
    cv2 = import_opencv()
    found, centres = cv2.findCirclesGrid(grey, (grid.columns, grid.rows), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
    if not found:
        raise _not_found_error(path, grid)
    return np.asarray(centres)


def _not_found_error(path: Path, grid: GridSection) -> InputError:
    features = "inner corners" if grid.kind == "chessboard" else "dots"
    expected = f"a {grid.kind} of {grid.rows} rows × {grid.columns} columns of {features}, completely visible"
    return InputError(str(path), "no such grid in the picture", expected)
