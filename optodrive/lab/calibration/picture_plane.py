"""The display's plane in a picture: corners of the grid, and the map from image positions to the display.

The corners or dots of the grid are found with subpixel accuracy and put in row order by three marks. The display is a
plane in perspective seen through a lens with distortion: one view of the grid determines a rational radial distortion
about a centre, followed by a homography. Several views first calibrate the camera with OpenCV; the residual distortion
of the first view is fitted in the same way.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, ReadOnlyArrays
from optodrive.lab.calibration.pictures import GridSection, Image, OriginSection, import_opencv

FALLBACK_CORNERS_PER_SIDE = 4
"""Corners per side of the smaller grid that is searched for if the whole grid is not found."""
MARK_TOLERANCE = 0.5
"""Largest distance of a mark from its corner, as a fraction of the shortest side between marked corners."""
DISTORTION_PRIOR_SIGMA = (0.03, 0.03, 0.3, 0.3, 0.3)
"""Prior sigma of the distortion centre and of the radial coefficients, in half diagonals."""
CORNER_NOISE_PX = 0.05
"""Expected noise of a corner, px."""
GAUSS_NEWTON_STEPS = 12
Camera = tuple[FloatArray, FloatArray]
"""Matrix and distortion, as OpenCV has them."""
DERIVATIVE_STEP = 1e-6
"""Step of the central differences."""


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
        cause = "the picture is flipped or marks are exchanged"
        expected = f"rows to the right and columns down, seen from the front: {cause}"
        raise InputError(f"{where}: origin.marks_px", "a grid that is mirrored in the picture", expected)
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
    return np.asarray(along @ np.array([[cos, sin], [-sin, cos]]) + np.array(origin.first_corner_m), dtype=np.float64)


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
        size_text = f"{grid.rows} rows × {grid.columns} columns"
        expected = f"{size_text}: inner corners, one fewer than squares, all of them visible"
        raise InputError(f"{path}: corners", f"{rows} × {columns}", expected)
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


@dataclass(frozen=True, eq=False)
class DisplayPlane(ReadOnlyArrays):
    """Map from image positions to positions on the display.

    centre_px, half_diagonal_px: origin and unit of normalised image positions; camera: OpenCV matrix and distortion,
    None from one view
    centre_m, half_diagonal_m: the same of the display; parameters: centre [2], distortion [3], homography [8];
    covariance: of the parameters
    residual_px: rms residual of the grid's corners per axis; grid_min_m, grid_max_m: extent of the grid
    """

    centre_px: FloatArray
    half_diagonal_px: float
    camera: Camera | None
    centre_m: FloatArray
    half_diagonal_m: float
    parameters: FloatArray
    covariance: FloatArray
    residual_px: float
    grid_min_m: FloatArray
    grid_max_m: FloatArray

    def position_m(self, image_px: FloatArray) -> FloatArray:
        """Return the positions on the display of image positions [n, 2], m, [n, 2]."""
        return self.centre_m + self.half_diagonal_m * _map_to_display(self._normalize(image_px), self.parameters)

    def jacobian_m(self, image_px: FloatArray) -> FloatArray:
        """Return the derivatives of positions by image positions [n, 2], m per px, [n, 2 of metres, 2 of pixels]."""
        steps = [self.position_m(image_px + 0.5 * step) - self.position_m(image_px - 0.5 * step) for step in np.eye(2)]
        return np.stack(steps, axis=-1)

    def sigma_m(self, image_px: FloatArray) -> FloatArray:
        """Return one sigma per axis of the map itself at image positions [n, 2], m, [n]."""
        jacobian = _jacobian(self._normalize(image_px), self.parameters)
        variance = np.einsum("nau,uv,nav->n", jacobian, self.covariance, jacobian) / 2.0
        return np.asarray(self.half_diagonal_m * np.sqrt(variance), dtype=np.float64)

    def is_inside_grid(self, positions_m: FloatArray, margin_m: float) -> BoolArray:
        """Return which positions [n, 2] lie within the grid plus margin_m, [n]."""
        within = (positions_m > self.grid_min_m - margin_m) & (positions_m < self.grid_max_m + margin_m)
        return np.asarray(within.all(axis=1), dtype=np.bool_)

    def _normalize(self, image_px: FloatArray) -> FloatArray:
        return (_undistort(image_px, self.camera) - self.centre_px) / self.half_diagonal_px


def fit_plane(views_px: list[FloatArray], corners_m: FloatArray, pitch_m: float, size: tuple[int, int]) -> DisplayPlane:
    """Fit the map to views of the grid, each [rows, columns, 2] px, the first of them in the display's plane.

    corners_m: positions of the corners in the plane, m, [rows, columns, 2]; size: columns and rows of the pictures
    """
    centre_px, half_diagonal_px = 0.5 * (np.array(size) - 1.0), 0.5 * float(np.hypot(*size))
    camera, camera_residual_px = _calibrate_camera(views_px, pitch_m, size) if len(views_px) > 1 else (None, 0.0)
    normalized = (_undistort(views_px[0].reshape(-1, 2), camera) - centre_px) / half_diagonal_px
    positions_m = corners_m.reshape(-1, 2)
    grid_min_m, grid_max_m = positions_m.min(axis=0), positions_m.max(axis=0)
    centre_m, half_diagonal_m = 0.5 * (grid_min_m + grid_max_m), 0.5 * float(np.hypot(*(grid_max_m - grid_min_m)))
    targets = (positions_m - centre_m) / half_diagonal_m
    homography = import_opencv().findHomography(normalized, targets, 0)[0]
    parameters = np.concatenate([np.zeros(5), (homography / homography[2, 2]).ravel()[:8]])
    parameters, covariance, residual = _fit_parameters(normalized, targets, parameters, half_diagonal_px)
    return DisplayPlane(
        centre_px,
        half_diagonal_px,
        camera,
        centre_m,
        half_diagonal_m,
        parameters,
        covariance,
        max(residual * half_diagonal_px, camera_residual_px),
        grid_min_m,
        grid_max_m,
    )


def _fit_parameters(
    normalized: FloatArray, targets: FloatArray, parameters: FloatArray, half_diagonal_px: float
) -> tuple[Any, Any, float]:
    """Fit by Gauss-Newton.

    Returns parameters, covariance at the fitted noise, and the rms residual on the image's scale.
    """
    prior_sigma = np.concatenate([DISTORTION_PRIOR_SIGMA, np.full(8, np.inf)])
    matrix = np.append(parameters[5:], 1.0).reshape(3, 3)
    middle = _map_to_display(np.zeros((1, 2)), parameters)[0]
    scale = np.sqrt(abs(np.linalg.det(matrix[:2, :2] - np.outer(middle, matrix[2, :2]))))
    noise = CORNER_NOISE_PX / half_diagonal_px * scale
    for _ in range(GAUSS_NEWTON_STEPS):
        jacobian = _jacobian(normalized, parameters).reshape(-1, len(parameters)) / noise
        residual = (targets - _map_to_display(normalized, parameters)).ravel() / noise
        normal = jacobian.T @ jacobian + np.diag(prior_sigma**-2.0)
        parameters = parameters + np.linalg.solve(normal, jacobian.T @ residual - prior_sigma**-2.0 * parameters)
    square = ((targets - _map_to_display(normalized, parameters)) ** 2).sum()
    rms = float(np.sqrt(square / max(1, 2 * len(normalized) - len(parameters))))
    normal = jacobian.T @ jacobian * (noise / max(rms, 0.1 * noise)) ** 2 + np.diag(prior_sigma**-2.0)
    return parameters, np.linalg.inv(normal), rms / scale


def _map_to_display(normalized: FloatArray, parameters: FloatArray) -> FloatArray:
    """Map normalised image positions [n, 2] to normalised display positions [n, 2]."""
    from_centre = normalized - parameters[:2]
    square = (from_centre**2).sum(axis=1, keepdims=True)
    stretch = 1.0 + square * (parameters[2] + square * (parameters[3] + square * parameters[4]))
    undistorted = from_centre / stretch + parameters[:2]
    matrix = np.append(parameters[5:], 1.0).reshape(3, 3)
    projected = undistorted @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(projected[:, :2] / projected[:, 2:], dtype=np.float64)


def _jacobian(normalized: FloatArray, parameters: FloatArray) -> FloatArray:
    """Return the derivatives of the map by its parameters, [n, 2, parameters]."""
    steps = DERIVATIVE_STEP * np.eye(len(parameters))
    later, earlier = ([_map_to_display(normalized, parameters + sign * step) for step in steps] for sign in (1, -1))
    return (np.stack(later, axis=-1) - np.stack(earlier, axis=-1)) / (2.0 * DERIVATIVE_STEP)


def _calibrate_camera(views_px: list[FloatArray], pitch_m: float, size: tuple[int, int]) -> tuple[Camera, float]:
    """Calibrate the camera from several views: matrix [3, 3] and distortion, and the rms residual per axis, px."""
    rows, columns = views_px[0].shape[:2]
    right, down = np.meshgrid(np.arange(columns), np.arange(rows))
    board = (pitch_m * np.stack([right, down, 0 * right], axis=-1).reshape(-1, 3)).astype(np.float32)
    views = [view.reshape(-1, 1, 2).astype(np.float32) for view in views_px]
    found = import_opencv().calibrateCamera([board] * len(views), views, size, None, None)
    residual_px, matrix, distortion = found[:3]
    camera = np.asarray(matrix, dtype=np.float64), np.asarray(distortion, dtype=np.float64)
    return camera, float(residual_px) / np.sqrt(2.0)


def _undistort(image_px: FloatArray, camera: Camera | None) -> FloatArray:
    """Return the image positions that an undistorted lens would show, px, [n, 2]."""
    if camera is None or not len(image_px):
        return image_px
    matrix, distortion = camera
    cv2 = import_opencv()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    points = image_px.reshape(-1, 1, 2)
    undistorted = cv2.undistortImagePoints(points, matrix, distortion, None, criteria)
    return np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)
