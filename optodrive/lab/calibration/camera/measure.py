"""Measurement of a folder of pictures, with the uncertainty and quality flags of its spots."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, freeze_arrays
from optodrive.lab.calibration.camera.folder import PictureFolder, read_picture_folder
from optodrive.lab.calibration.camera.grid import find_grid, grid_corners_m, orient_to_marks
from optodrive.lab.calibration.camera.image import PictureReader
from optodrive.lab.calibration.camera.plane import DisplayPlane, fit_plane
from optodrive.lab.calibration.camera.spot import DetectedSpot, find_spot
from optodrive.lab.calibration.spots import MeasuredSpots

CORNER_RESIDUAL_MAX_PX = 0.5
"""Largest rms residual per axis of an even and flat grid, px."""


@dataclass(frozen=True, eq=False)
class CameraMeasurement:
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

    def __post_init__(self) -> None:
        freeze_arrays(self)


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
        raise InputError(
            str(pictures.grid_views[0]),
            found,
            f"at most {CORNER_RESIDUAL_MAX_PX:g} px: check that the grid is flat and in focus",
        )
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
