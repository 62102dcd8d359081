"""Check of a whole display's responses, with the probable cause in the error message."""

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
"""Units that are mistaken for metres, per metre."""
UNIT_TOLERANCE = 1.2
"""Largest ratio, either way, of a display's typical gain to a unit's factor."""


def check_responses(where: str, by_pixel: dict[int, list[PixelResponse]], optics: Optics) -> None:
    """Check that a display responds in metres and upwards. Raise InputError with the probable cause."""
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
        expected = "at least one run with pulses on the measured pixel and aim_x_m = aim_y_m = 0"
        raise InputError(f"{where}: displacement_m", found, expected)
    mean, sigma = np.array(means).T
    significant = mean[np.abs(mean) > SIGNIFICANCE_SIGMAS * sigma]
    # Dead pixels do not show the unit; the upper half of the responding pixels does.
    size = float(np.median(np.sort(np.abs(significant))[len(significant) // 2 :])) if len(significant) else 0.0
    typical = float(np.median(significant[np.abs(significant) >= 0.5 * size])) if len(significant) else 0.0
    place, unit = f"{where}: displacement_m", _guess_unit(abs(typical))
    hint = f"; these look like {unit}" if unit else ""
    if abs(typical) < GAIN_MIN:
        found = f"at most {size:.2g} of the model's heights at {len(means)} pixels"
        raise InputError(place, found, "a pixel that responds, and heights in metres")
    found = f"{typical:.3g} × the model's heights at {len(means)} pixels"
    if typical < 0.0:
        raise InputError(place, found, f"heights that increase upwards{hint}")
    if typical > GAIN_MAX:
        raise InputError(place, found, f"metres, and the model of this display{hint}")


def _guess_unit(ratio: float) -> str | None:
    for name, factor in UNIT_FACTORS.items():
        if factor / UNIT_TOLERANCE < ratio < factor * UNIT_TOLERANCE:
            return name
    return None
