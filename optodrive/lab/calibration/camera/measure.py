"""A folder of pictures to spots in metres, with how sure they are and what is to be said of them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, freeze_arrays
from optodrive.lab.calibration.camera.folder import Pictures, read_folder
from optodrive.lab.calibration.camera.grid import find_grid, grid_m, turned_to_marks
from optodrive.lab.calibration.camera.image import Reader
from optodrive.lab.calibration.camera.plane import Plane, fit_plane
from optodrive.lab.calibration.camera.spot import Seen, find_spot
from optodrive.lab.calibration.spots import Spots

CORNERS_MAX_PX = 0.5
"""A grid that is even and flat leaves less than this to the fit, rms on an axis."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Spots as pictures show them.

    names: of the pictures, in the order of the spots; sigma_m: of each on an axis, [n]; scale_m: of a pixel
    where most spots are; saturated, outside: which spots have a saturated core, lie outside the grid, [n]
    """

    spots: Spots
    names: tuple[str, ...]
    sigma_m: FloatArray
    saturated: BoolArray
    outside: BoolArray
    plane: Plane
    scale_m: float
    views: int

    def __post_init__(self) -> None:
        freeze_arrays(self)


def measure_folder(folder: Path) -> Measured:
    """Measure every spot of a folder; InputError names the picture and what is wrong in it."""
    pictures = read_folder(folder)
    reader = Reader(pictures)
    plane = _plane(pictures, reader)
    without = reader.without_beam(pictures)
    seen = [find_spot(str(each.path), reader(each.path), without) for each in pictures.spots]
    return _placed(pictures, plane, seen)


def _plane(pictures: Pictures, reader: Reader) -> Plane:
    grid, origin = pictures.grid, pictures.origin
    views = [find_grid(path, reader(path), grid) for path in pictures.views]
    views[0] = turned_to_marks(str(pictures.path), views[0], origin)
    plane = fit_plane(views, grid_m(grid, origin), grid.pitch_m, (reader.columns, reader.rows))
    if plane.left_px > CORNERS_MAX_PX:
        found = f"corners {plane.left_px:.2f} px off an even, flat grid, rms"
        raise InputError(str(pictures.views[0]), found, f"{CORNERS_MAX_PX:g} px at most: is it flat, and sharp?")
    return plane


def _placed(pictures: Pictures, plane: Plane, seen: list[Seen]) -> Measured:
    at_px = np.array([each.at_px for each in seen]).reshape(-1, 2)
    places_m = plane.places_m(at_px)
    # The square root of the mean square over both axes.
    a_pixel_m = np.sqrt((plane.derivatives_m(at_px) ** 2).sum(axis=(1, 2)) / 2.0)
    sigma_m = np.hypot(a_pixel_m * [each.sigma_px for each in seen], plane.sigma_m(at_px))
    codes = np.array([(each.x_code, each.y_code) for each in pictures.spots]).reshape(-1, 2)
    return Measured(
        spots=Spots.of(np.column_stack([codes, places_m])),
        names=tuple(each.path.name for each in pictures.spots),
        sigma_m=sigma_m,
        saturated=np.array([each.saturated > 0 for each in seen], dtype=bool),
        outside=~plane.inside(places_m, 0.5 * pictures.grid.pitch_m),
        plane=plane,
        scale_m=float(np.median(a_pixel_m)) if len(seen) else float("nan"),
        views=len(pictures.views),
    )
