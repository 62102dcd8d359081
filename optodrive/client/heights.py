"""Conversion of heights in µm to the forms that the daemon accepts: by pixel for REST, bytes for the stream."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optodrive.core.errors import InputError
from optodrive.core.quantity import um_to_m
from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import PixelLayout
from optodrive.planning.stimuli.binary_frame import FRAME_NUMBER_MAX, HEADER, HEIGHT_UNIT_M, MAGIC

HeightsLike = Mapping[int, float] | ArrayLike
"""Peak heights in µm: {pixel: height}, [p] by pixel, or [rows, columns] by position; NaN or 0: no target."""
EXPECTED = {"heights_um": "a height ≥ 0 in µm", "intensity": "an intensity ≥ 0"}
"""Expected value by the name of an argument."""
TENTHS_UM_MAX = 0xFFFF


def convert_to_pixels(values: HeightsLike, layout: PixelLayout, name: str = "heights_um") -> FloatArray:
    """Convert heights, or intensities with the name "intensity", to [p], 0 for no target.

    Raises InputError for an invalid shape or value.
    """
    if isinstance(values, Mapping):
        return _check_values(_convert_mapping(values, len(layout), name), name)
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(name, values, "numbers", "bad_target") from None
    rows, columns = int(layout.row.max()) + 1, int(layout.column.max()) + 1
    if array.shape == (rows, columns):
        return _check_values(array[layout.row, layout.column], name)
    if array.shape != (len(layout),):
        expected = f"{{pixel: value}}, an array of {len(layout)}, or one of {rows} rows and {columns} columns"
        raise InputError(name, array.shape or values, expected, "bad_target")
    return _check_values(array, name)


def _convert_mapping(values: Mapping[Any, Any], pixels: int, name: str) -> FloatArray:
    array = np.zeros(pixels)
    for pixel, value in values.items():
        if not isinstance(pixel, int | np.integer) or not 0 <= pixel < pixels:
            raise InputError(name, pixel, f"a pixel, 0…{pixels - 1}", "unknown_pixel")
        try:
            array[pixel] = value
        except (TypeError, ValueError):
            raise InputError(f"{name}[{pixel}]", value, EXPECTED[name], "bad_target") from None
    return array


def _check_values(array: FloatArray, name: str) -> FloatArray:
    invalid = np.flatnonzero((array < 0) | np.isinf(array))
    if invalid.size:
        pixel = int(invalid[0])
        raise InputError(f"{name}[{pixel}]", float(array[pixel]), EXPECTED[name], "bad_target")
    return np.nan_to_num(array)


def encode_json(values: FloatArray) -> dict[str, float]:
    """Encode the pixels with a target and their heights or intensities in the form of FRAMES.json."""
    return {str(pixel): float(values[pixel]) for pixel in np.flatnonzero(values).tolist()}


def encode_target(
    heights_um: HeightsLike | None, intensity: HeightsLike | None, layout: PixelLayout
) -> dict[str, dict[str, float]]:
    """Return heights or intensities as the key of a frame. Raise InputError unless exactly one is given."""
    if intensity is not None and heights_um is None:
        return {"intensity": encode_json(convert_to_pixels(intensity, layout, "intensity"))}
    if heights_um is not None and intensity is None:
        return {"target_um": encode_json(convert_to_pixels(heights_um, layout))}
    given = "neither" if heights_um is None else "both"
    raise InputError("heights_um, intensity", given, "one of them", "bad_target")


def encode_frame(number: int, heights_um: FloatArray) -> bytes:
    """Encode a streamed frame. Raise InputError for a height that does not fit in 16 bits."""
    tenths = np.rint(um_to_m(heights_um) / HEIGHT_UNIT_M)
    pixel = int(tenths.argmax())
    if tenths[pixel] > TENTHS_UM_MAX:
        expected = f"at most {TENTHS_UM_MAX / 10:g} µm in a stream"
        raise InputError(f"heights_um[{pixel}]", float(heights_um[pixel]), expected, "bad_target")
    return HEADER.pack(MAGIC, number & FRAME_NUMBER_MAX) + tenths.astype("<u2").tobytes()
