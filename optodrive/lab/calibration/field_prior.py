"""Prior of a field from its nominal parameters and their mechanical tolerances."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from optodrive.core.types.arrays import FloatArray, freeze_arrays
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.config_sections import DIRECT_WIRING, Wiring
from optodrive.device.field_geometry import CENTRE_CODE, CODE_MAX, FieldGeometry
from optodrive.device.field_surface import Extent

MARGIN_M = 5e-3
"""Margin of the field beyond the pixels on every side, m; uncorrected codes miss by millimetres."""
HALF_EXTENT_MIN_M = 1e-3
"""Smallest half extent of a display, m; a single pixel has none."""
SPOT_NOISE_M = 10e-6
"""Expected noise of a spot, rms per axis, m; fitted if the spots suffice."""
SURFACE_RMS_M = 12e-6
"""Expected surface, rms per axis, m; fitted if the spots suffice."""


@dataclass(frozen=True, eq=False)
class FieldPrior:
    """Prior distribution of a field's parameters.

    mean, sigma: of each parameter of the geometry; extent: codes of the field; display_extent: codes of the display
    rad_per_code, focal_length_m, wiring: of the configuration; noise_m, surface_m: expected rms per axis
    field_area_m2: area over which outliers are uniformly distributed; display: name of the display
    """

    mean: FieldGeometry
    sigma: FloatArray
    rad_per_code: float
    focal_length_m: float
    extent: Extent
    display_extent: Extent
    field_area_m2: float
    noise_m: float = SPOT_NOISE_M
    surface_m: float = SURFACE_RMS_M
    display: str = ""
    wiring: Wiring = DIRECT_WIRING

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @classmethod
    def from_config(cls, config: Config) -> Self:
        """Build the prior from a configuration's nominal values and the tolerances of an ordinary laboratory."""
        scanner, layout = config.scanner, build_pixel_layout(config.display)
        focal_m, range_rad = scanner.focal_length_m, scanner.range_rad
        display_m = [max(HALF_EXTENT_MIN_M, float(np.abs(axis).max())) for axis in (layout.x_m, layout.y_m)]
        half_m = [half + MARGIN_M for half in display_m]
        edge_rad = float(np.hypot(half_m[0], half_m[1])) / focal_m
        code_m = 2.0 * focal_m * scanner.rad_per_code
        x_half, y_half = (min(half / code_m, float(CODE_MAX - CENTRE_CODE)) for half in half_m)
        tolerances = {
            "gain_x": (1.0, 0.01),
            "gain_y": (1.0, 0.01),
            "offset_x_rad": (0.0, 2e-3),
            "offset_y_rad": (0.0, 2e-3),
            "cross_x": (0.0, 5e-3),
            "cross_y": (0.0, 5e-3),
            "cubic_x_per_rad2": (0.0, 2e-3 / range_rad**2),
            "cubic_y_per_rad2": (0.0, 2e-3 / range_rad**2),
            "mirror_distance_m": (14e-3, 4e-3),
            "lens_distance_m": (45e-3, 12e-3),
            "focal_length_m": (focal_m, 0.005 * focal_m),
            "distortion3_per_rad2": (0.0, 3e-3 / edge_rad**2),
            "distortion5_per_rad4": (0.0, 1e-3 / edge_rad**4),
            "shift_x_m": (0.0, 2e-3),
            "shift_y_m": (0.0, 2e-3),
            "turn_rad": (0.0, 0.03),
            "tilt_x_rad": (0.0, 0.015),
            "tilt_y_rad": (0.0, 0.015),
        }
        return cls(
            mean=FieldGeometry(**{name: mean for name, (mean, _) in tolerances.items()}),
            sigma=np.array([tolerances[name][1] for name in FieldGeometry._fields]),
            rad_per_code=scanner.rad_per_code,
            focal_length_m=focal_m,
            extent=Extent(float(CENTRE_CODE), float(CENTRE_CODE), x_half, y_half),
            display_extent=Extent(float(CENTRE_CODE), float(CENTRE_CODE), display_m[0] / code_m, display_m[1] / code_m),
            field_area_m2=4.0 * half_m[0] * half_m[1],
            display=config.name,
            wiring=scanner.wiring,
        )
