"""What is wrong with a whole display's heights, named as what it is."""

import numpy as np

from optodrive.core.errors import InputError
from optodrive.device.pixel_map import GAIN_MAX, GAIN_MIN
from optodrive.lab.calibration.pixels.fit import SIGNIFICANCE_SIGMAS, Optics, select_centred, weighted_mean
from optodrive.lab.calibration.pixels.response import PixelResponse

UNIT_FACTORS = {
    "millimetres": 1e3,
    "micrometres": 1e6,
    "centimetres": 1e2,
    "inches": 1.0 / 0.0254,
    "inches taken for millimetres, or the other way round": 25.4,
}
UNIT_TOLERANCE = 1.2
"""Gains of a whole display are so near to 1, either way, that a unit shows."""


def check_responses(where: str, by_pixel: dict[int, list[PixelResponse]], optics: Optics) -> None:
    """Refuse a display of which nothing responds, or all of which does so in another unit or upside down."""
    means = []
    for responses in by_pixel.values():
        aim_m = np.array([[item.aim_x_m for item in responses], [item.aim_y_m for item in responses]])
        is_centred = select_centred(aim_m, optics)
        if is_centred.any():
            value = np.array([item.ratio for item in responses])[is_centred]
            sigma = np.array([item.sigma for item in responses])[is_centred]
            means.append(weighted_mean(value, sigma))
    if not means:
        found = f"heights of {len(by_pixel)} pixels under light aimed at them"
        raise InputError(f"{where}: displacement_m", found, "some: pulses on the pixel measured, aim_x_m and aim_y_m 0")
    mean, sigma = np.array(means).T
    significant = mean[np.abs(mean) > SIGNIFICANCE_SIGMAS * sigma]
    # Dead pixels say nothing of the unit: the upper half of those that answer does.
    size = float(np.median(np.sort(np.abs(significant))[len(significant) // 2 :])) if len(significant) else 0.0
    typical = float(np.median(significant[np.abs(significant) >= 0.5 * size])) if len(significant) else 0.0
    place, unit = f"{where}: displacement_m", _guess_unit(abs(typical))
    hint = f"; these look like {unit}" if unit else ""
    if abs(typical) < GAIN_MIN:
        found = f"at most {size:.2g} of the model's heights at {len(means)} pixels"
        raise InputError(place, found, "a pixel that responds, and heights in metres")
    found = f"{typical:.3g} × the model's heights at {len(means)} pixels"
    if typical < 0.0:
        raise InputError(place, found, f"upwards counted as more{hint}")
    if typical > GAIN_MAX:
        raise InputError(place, found, f"metres, and the model of this display{hint}")


def _guess_unit(ratio: float) -> str | None:
    for name, factor in UNIT_FACTORS.items():
        if factor / UNIT_TOLERANCE < ratio < factor * UNIT_TOLERANCE:
            return name
    return None
