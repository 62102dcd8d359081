"""Map from image positions to the display, a plane in perspective seen through a lens with distortion.

One view of the grid determines a rational radial distortion about a centre, followed by a homography. Several views
first calibrate the camera with OpenCV; the residual distortion of the first view is fitted in the same way.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray, freeze_arrays
from optodrive.lab.calibration.camera.image import import_opencv

DISTORTION_PRIOR_SIGMA = (0.03, 0.03, 0.3, 0.3, 0.3)
"""Prior sigma of the distortion centre and of the radial coefficients, in half diagonals."""
CORNER_NOISE_PX = 0.05
"""Expected noise of a corner, px."""
GAUSS_NEWTON_STEPS = 12
DERIVATIVE_STEP = 1e-6
"""Step of the central differences."""


@dataclass(frozen=True, eq=False)
class DisplayPlane:
    """Map from image positions to positions on the display.

    centre_px, half_diagonal_px: origin and unit of normalised image positions; camera: OpenCV matrix and distortion,
    None from one view
    centre_m, half_diagonal_m: the same of the display; parameters: centre [2], distortion [3], homography [8];
    covariance: of the parameters
    residual_px: rms residual of the grid's corners per axis; grid_min_m, grid_max_m: extent of the grid
    """

    centre_px: FloatArray
    half_diagonal_px: float
    camera: tuple[FloatArray, FloatArray] | None
    centre_m: FloatArray
    half_diagonal_m: float
    parameters: FloatArray
    covariance: FloatArray
    residual_px: float
    grid_min_m: FloatArray
    grid_max_m: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

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
    scale = np.sqrt(
        abs(np.linalg.det(matrix[:2, :2] - np.outer(_map_to_display(np.zeros((1, 2)), parameters)[0], matrix[2, :2])))
    )
    noise = CORNER_NOISE_PX / half_diagonal_px * scale
    for _ in range(GAUSS_NEWTON_STEPS):
        jacobian = _jacobian(normalized, parameters).reshape(-1, len(parameters)) / noise
        residual = (targets - _map_to_display(normalized, parameters)).ravel() / noise
        normal = jacobian.T @ jacobian + np.diag(prior_sigma**-2.0)
        parameters = parameters + np.linalg.solve(normal, jacobian.T @ residual - prior_sigma**-2.0 * parameters)
    rms = float(
        np.sqrt(
            ((targets - _map_to_display(normalized, parameters)) ** 2).sum()
            / max(1, 2 * len(normalized) - len(parameters))
        )
    )
    normal = jacobian.T @ jacobian * (noise / max(rms, 0.1 * noise)) ** 2 + np.diag(prior_sigma**-2.0)
    return parameters, np.linalg.inv(normal), rms / scale


def _map_to_display(normalized: FloatArray, parameters: FloatArray) -> FloatArray:
    """Map normalised image positions [n, 2] to normalised display positions [n, 2]."""
    from_centre = normalized - parameters[:2]
    square = (from_centre**2).sum(axis=1, keepdims=True)
    undistorted = (
        from_centre / (1.0 + square * (parameters[2] + square * (parameters[3] + square * parameters[4])))
        + parameters[:2]
    )
    matrix = np.append(parameters[5:], 1.0).reshape(3, 3)
    projected = undistorted @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(projected[:, :2] / projected[:, 2:], dtype=np.float64)


def _jacobian(normalized: FloatArray, parameters: FloatArray) -> FloatArray:
    """Return the derivatives of the map by its parameters, [n, 2, parameters]."""
    steps = DERIVATIVE_STEP * np.eye(len(parameters))
    differences = [
        _map_to_display(normalized, parameters + step) - _map_to_display(normalized, parameters - step)
        for step in steps
    ]
    return np.stack(differences, axis=-1) / (2.0 * DERIVATIVE_STEP)


def _calibrate_camera(
    views_px: list[FloatArray], pitch_m: float, size: tuple[int, int]
) -> tuple[tuple[FloatArray, FloatArray], float]:
    """Calibrate the camera from several views: matrix [3, 3] and distortion, and the rms residual per axis, px."""
    rows, columns = views_px[0].shape[:2]
    right, down = np.meshgrid(np.arange(columns), np.arange(rows))
    board = (pitch_m * np.stack([right, down, 0 * right], axis=-1).reshape(-1, 3)).astype(np.float32)
    views = [view.reshape(-1, 1, 2).astype(np.float32) for view in views_px]
    residual_px, matrix, distortion, _, _ = import_opencv().calibrateCamera(
        [board] * len(views), views, size, None, None
    )
    camera = np.asarray(matrix, dtype=np.float64), np.asarray(distortion, dtype=np.float64)
    return camera, float(residual_px) / np.sqrt(2.0)


def _undistort(image_px: FloatArray, camera: tuple[FloatArray, FloatArray] | None) -> FloatArray:
    """Return the image positions that an undistorted lens would show, px, [n, 2]."""
    if camera is None or not len(image_px):
        return image_px
    matrix, distortion = camera
    cv2 = import_opencv()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    points = image_px.reshape(-1, 1, 2)
    undistorted = cv2.undistortImagePoints(points, matrix, distortion, None, criteria)
    return np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)
