"""Spots of the beam in pictures: each with its centre and uncertainty, and those of a folder on the display."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, ReadOnlyArrays
from optodrive.lab.calibration.picture_plane import DisplayPlane, find_grid, fit_plane, grid_corners_m, orient_to_marks
from optodrive.lab.calibration.pictures import Image, PictureFolder, PictureReader, import_opencv, read_picture_folder
from optodrive.lab.calibration.spots import MeasuredSpots

SMOOTHING_SIGMA_PX = 1.5
"""Sigma of the smoothing before detection, px."""
DETECTION_SNR_MIN = 8.0
"""Smallest ratio of a blob's brightness to the smoothed noise."""
BLOB_THRESHOLD_FRACTION = 0.2
"""Threshold of a blob, as a fraction of the largest brightness."""
BLOB_AREA_MIN_PX = 4
"""Smallest area of a blob, px."""
RIVAL_FRACTION_MAX = 0.5
"""Largest light of a second blob, as a fraction of the spot's; a brighter one could be the spot."""
CORE_MOMENT = 0.5 * np.log(2.0)
"""Second moment of a Gaussian's core above half its peak, in units of the Gaussian's own."""
WINDOW_SIGMA_MIN_PX = 0.8
"""Smallest sigma of the window, px."""
CENTROID_ITERATIONS_MAX = 60
CENTROID_TOLERANCE_PX = 1e-4
"""Step of the centre at which the iteration ends, px."""
WINDOW_EXTENT_SIGMAS = 4.0
"""Half width of the evaluated area, in sigmas of the window."""
PATTERN_CONTRAST_MAX, PATTERN_NOISE_FACTOR_MAX = 0.5, 10.0
"""Largest variation of a plain background, as a fraction of its brightness and as a multiple of the noise."""
SATURATED_PIXELS_MIN = 5
"""Smallest number of equally bright pixels at the maximum that indicates saturation."""
QUANTIZATION_RMS_COUNTS = 0.3
"""Rms error of rounding to whole counts."""
CORNER_RESIDUAL_MAX_PX = 0.5
"""Largest rms residual per axis of an even and flat grid, px."""


class DetectedSpot(NamedTuple):
    """A spot in a picture.

    centre_px: [2]; sigma_px: one sigma per axis; saturated_pixels: their number; rival_fraction: light of the next
    brightest blob, as a fraction of the spot's
    """

    centre_px: FloatArray
    sigma_px: float
    saturated_pixels: int
    rival_fraction: float


def find_spot(where: str, picture: Image, background: Image) -> DetectedSpot:
    """Find the one spot in a picture.

    background: the same picture without the beam

    Raises InputError with the picture if there is no single, complete spot on a plain background.
    """
    cv2 = import_opencv()
    light = picture.astype(np.float32) - background.astype(np.float32)
    light -= np.median(light[::3, ::3])
    noise = max(QUANTIZATION_RMS_COUNTS, 1.4826 * float(np.median(np.abs(light[::3, ::3]))))
    # The median removes hot pixels.
    smooth = cv2.GaussianBlur(cv2.medianBlur(light, 3), (0, 0), SMOOTHING_SIGMA_PX)
    smooth_noise = max(1.4826 * float(np.median(np.abs(smooth[::3, ::3]))), 0.2 * noise)
    brightest, dimmest = float(smooth.max()), DETECTION_SNR_MIN * smooth_noise
    if brightest < dimmest:
        found = f"nothing brighter than {brightest:.1f} counts above the background"
        expected = f"a spot of at least {dimmest:.1f}, {DETECTION_SNR_MIN:g} times the noise"
        raise InputError(where, found, expected)
    labels, lights, centres_px = _find_blobs(smooth, light, max(dimmest, BLOB_THRESHOLD_FRACTION * brightest))
    order = np.argsort(-lights)
    spot = int(order[0])
    rival_fraction = float(lights[order[1]] / lights[spot]) if len(order) > 1 else 0.0
    if rival_fraction > RIVAL_FRACTION_MAX:
        x, y = centres_px[spot]
        x2, y2 = centres_px[order[1]]
        found = f"two similar spots, at {x:.0f} {y:.0f} and {x2:.0f} {y2:.0f} px, {rival_fraction:.0%} as bright"
        raise InputError(where, found, f"one spot; a reflection has at most {RIVAL_FRACTION_MAX:.0%} of its light")
    window = _fit_window(labels == spot + 1, smooth)
    _check_edge(where, centres_px[spot], window, light.shape)
    _check_background(where, centres_px[spot], window, background, noise)
    centre_px, noise_sigma_px = _compute_centroid(light, noise, centres_px[spot], window)
    wide_px, wide_sigma_px = _compute_centroid(light, noise, centre_px, 2.0 * window)
    # A shift in a wider window beyond the noise indicates an asymmetric spot or stray light.
    asymmetry_px2 = max(0.0, float(((wide_px - centre_px) ** 2).mean()) - wide_sigma_px**2)
    sigma_px = float(np.sqrt(noise_sigma_px**2 + asymmetry_px2))
    return DetectedSpot(centre_px, sigma_px, _count_saturated_pixels(picture, labels == spot + 1), rival_fraction)


def _find_blobs(smooth: Any, light: Any, level: float) -> tuple[Any, FloatArray, FloatArray]:
    """Return labels [rows, columns], and each blob's light (0 if it is small) and centre [n, 2], from label 1."""
    found = import_opencv().connectedComponentsWithStats((smooth > level).astype(np.uint8))
    count, labels, statistics, centres_px = found
    lights = np.bincount(labels.ravel(), weights=light.ravel().astype(np.float64), minlength=count)[1:]
    return labels, np.where(statistics[1:, -1] >= BLOB_AREA_MIN_PX, lights, 0.0), centres_px[1:]


def _fit_window(blob: Any, smooth: Any) -> FloatArray:
    """Return the second moments of a blob's light from its core, px², [2, 2], with a minimum width.

    The core is the region above half the peak: a reflection that touches the spot is weaker and does not widen it.
    """
    within = np.where(blob, smooth, 0.0)
    peak = np.unravel_index(int(np.argmax(within)), within.shape)
    _, labels = import_opencv().connectedComponents((within > 0.5 * within[peak]).astype(np.uint8))
    y, x = np.nonzero(labels == labels[peak])
    moments = np.cov(np.stack([x, y]), bias=True) / CORE_MOMENT
    size, axes = np.linalg.eigh(moments)
    return np.asarray((axes * np.maximum(size, WINDOW_SIGMA_MIN_PX**2)) @ axes.T, dtype=np.float64)


def _check_edge(where: str, centre_px: FloatArray, window: FloatArray, shape: tuple[int, ...]) -> None:
    extent_px = 2.0 * np.sqrt(np.diag(window))
    if np.any(centre_px < extent_px) or np.any(centre_px > np.array(shape[::-1]) - 1.0 - extent_px):
        found = f"a spot at {centre_px[0]:.0f} {centre_px[1]:.0f} px, cut by the picture's edge"
        raise InputError(where, found, "the whole spot")


def _check_background(where: str, centre_px: FloatArray, window: FloatArray, background: Image, noise: float) -> None:
    """Refuse a spot on a pattern, as dark areas reflect less and bias the centre."""
    extent_px = int(np.ceil(2.0 * np.sqrt(np.linalg.eigvalsh(window)[-1])))
    x, y = np.rint(centre_px).astype(int)
    rows, columns = (slice(max(0, at - extent_px), at + extent_px + 1) for at in (y, x))
    dark, bright = np.percentile(background[rows, columns], (5, 95))
    if bright - dark > max(PATTERN_CONTRAST_MAX * bright, PATTERN_NOISE_FACTOR_MAX * noise):
        found = f"a spot at {x} {y} px on a pattern of {dark:.0f} to {bright:.0f} counts"
        raise InputError(where, found, "plain paper behind it, without the grid")


def _compute_centroid(light: Any, noise: float, start: FloatArray, window: FloatArray) -> tuple[FloatArray, float]:
    """Return the centre of the light under a Gaussian window that follows it, px, and one sigma per axis by noise.

    A window symmetric about the centre is unbiased with a saturated core, which is symmetric as well.
    """
    inverse = np.linalg.inv(window)
    centre_px = np.array(start, dtype=np.float64)
    extent_px = int(np.ceil(WINDOW_EXTENT_SIGMAS * np.sqrt(np.linalg.eigvalsh(window)[-1])))
    for _ in range(CENTROID_ITERATIONS_MAX):
        low = np.maximum(np.rint(centre_px).astype(int) - extent_px, 0)
        end = np.rint(centre_px).astype(int) + extent_px + 1
        part = light[low[1] : end[1], low[0] : end[0]]
        y, x = np.mgrid[low[1] : low[1] + part.shape[0], low[0] : low[0] + part.shape[1]]
        offset_px = np.stack([x - centre_px[0], y - centre_px[1]], axis=-1)
        distance2 = np.einsum("...a,ab,...b->...", offset_px, inverse, offset_px)
        weight = np.exp(-0.5 * distance2)
        is_margin = distance2 > 0.6 * WINDOW_EXTENT_SIGMAS**2
        clean = part - (np.median(part[is_margin]) if is_margin.any() else 0.0)
        total = float((weight * clean).sum())
        if total <= 0.0:
            return np.array(start, dtype=np.float64), float("inf")
        # With a window as wide as the spot, the first moment is half of the distance to the centre.
        step = 2.0 * np.einsum("yx,yxa->a", weight * clean, offset_px) / total
        centre_px = centre_px + np.clip(step, -extent_px, extent_px)
        if np.abs(step).max() < CENTROID_TOLERANCE_PX:
            break
    shot = noise**2 + np.maximum(clean, 0.0) * QUANTIZATION_RMS_COUNTS**2
    variance = 4.0 * np.einsum("yx,yxa->a", weight**2 * shot, offset_px**2) / total**2
    return centre_px, float(np.sqrt(variance.mean()))


def _count_saturated_pixels(picture: Image, blob: Any) -> int:
    top = int(picture[blob].max())
    count = int((picture[blob] == top).sum())
    return count if count >= SATURATED_PIXELS_MIN and (picture.dtype != np.uint8 or top >= 250) else 0


@dataclass(frozen=True, eq=False)
class CameraMeasurement(ReadOnlyArrays):
    """Spots measured from pictures.

    names: of the pictures, in the order of the spots; sigma_m: of each spot per axis, [n]
    is_saturated, is_outside: spots with a saturated core, spots outside the grid, [n]
    pixel_scale_m: median size of an image pixel at the spots, m
    """

    spots: MeasuredSpots
    names: tuple[str, ...]
    sigma_m: FloatArray
    is_saturated: BoolArray
    is_outside: BoolArray
    plane: DisplayPlane
    pixel_scale_m: float
    view_count: int


def measure_folder(folder: Path) -> CameraMeasurement:
    """Measure every spot of a folder. Raise InputError with the picture and its defect."""
    pictures = read_picture_folder(folder)
    reader = PictureReader(pictures)
    plane = _fit_grid_plane(pictures, reader)
    background = reader.read_background(pictures)
    detected = [find_spot(str(each.path), reader(each.path), background) for each in pictures.spot_pictures]
    return _locate_spots(pictures, plane, detected)


def _fit_grid_plane(pictures: PictureFolder, reader: PictureReader) -> DisplayPlane:
    grid, origin = pictures.grid, pictures.origin
    views = [find_grid(path, reader(path), grid) for path in pictures.grid_views]
    views[0] = orient_to_marks(str(pictures.path), views[0], origin)
    plane = fit_plane(views, grid_corners_m(grid, origin), grid.pitch_m, (reader.columns, reader.rows))
    if plane.residual_px > CORNER_RESIDUAL_MAX_PX:
        found = f"corners {plane.residual_px:.2f} px off an even, flat grid, rms"
        expected = f"at most {CORNER_RESIDUAL_MAX_PX:g} px: check that the grid is flat and in focus"
        raise InputError(str(pictures.grid_views[0]), found, expected)
    return plane


def _locate_spots(pictures: PictureFolder, plane: DisplayPlane, detected: list[DetectedSpot]) -> CameraMeasurement:
    centre_px = np.array([each.centre_px for each in detected]).reshape(-1, 2)
    places_m = plane.position_m(centre_px)
    # Root mean square over both axes.
    scale_m = np.sqrt((plane.jacobian_m(centre_px) ** 2).sum(axis=(1, 2)) / 2.0)
    sigma_m = np.hypot(scale_m * [each.sigma_px for each in detected], plane.sigma_m(centre_px))
    codes = np.array([(each.x_code, each.y_code) for each in pictures.spot_pictures]).reshape(-1, 2)
    return CameraMeasurement(
        spots=MeasuredSpots.from_table(np.column_stack([codes, places_m])),
        names=tuple(each.path.name for each in pictures.spot_pictures),
        sigma_m=sigma_m,
        is_saturated=np.array([each.saturated_pixels > 0 for each in detected], dtype=bool),
        is_outside=~plane.is_inside_grid(places_m, 0.5 * pictures.grid.pitch_m),
        plane=plane,
        pixel_scale_m=float(np.median(scale_m)) if len(detected) else float("nan"),
        view_count=len(pictures.grid_views),
    )
