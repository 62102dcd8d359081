"""Conversion of heights in µm to the forms that the daemon accepts: by pixel for REST, bytes for the stream."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.units import um_to_m
from optodrive.device.config import PixelLayout
from optodrive.planning.stimuli.streamed_frame import FRAME_NUMBER_MAX, HEADER, HEIGHT_UNIT_M, MAGIC

HeightsLike = Mapping[int, float] | ArrayLike
"""Peak heights in µm: {pixel: height}, [p] by pixel, or [rows, columns] by position; NaN or 0: no target."""

TENTHS_UM_MAX = 0xFFFF


def convert_to_pixels(heights_um: HeightsLike, layout: PixelLayout) -> FloatArray:
    """Convert heights to [p] in µm, 0 for no target. Raise InputError for an invalid shape or height."""
    if isinstance(heights_um, Mapping):
        return _check_heights(_convert_mapping(heights_um, len(layout)))
    try:
        array = np.asarray(heights_um, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("heights_um", heights_um, "numbers in µm", "bad_target") from None
    rows, columns = int(layout.row.max()) + 1, int(layout.column.max()) + 1
    if array.shape == (rows, columns):
        return _check_heights(array[layout.row, layout.column])
    if array.shape != (len(layout),):
        expected = f"{{pixel: µm}}, an array of {len(layout)}, or one of {rows} rows and {columns} columns"
        raise InputError("heights_um", array.shape, expected, "bad_target")
    return _check_heights(array)


def _convert_mapping(heights_um: Mapping[Any, Any], pixels: int) -> FloatArray:
    array = np.zeros(pixels)
    for pixel, height_um in heights_um.items():
        if not isinstance(pixel, int | np.integer) or not 0 <= pixel < pixels:
            raise InputError("heights_um", pixel, f"a pixel, 0…{pixels - 1}", "unknown_pixel")
        try:
            array[pixel] = height_um
        except (TypeError, ValueError):
            raise InputError(f"heights_um[{pixel}]", height_um, "a height ≥ 0 in µm", "bad_target") from None
    return array


def _check_heights(heights_um: FloatArray) -> FloatArray:
    invalid = np.flatnonzero((heights_um < 0) | np.isinf(heights_um))
    if invalid.size:
        pixel = int(invalid[0])
        raise InputError(f"heights_um[{pixel}]", float(heights_um[pixel]), "a height ≥ 0 in µm", "bad_target")
    return np.nan_to_num(heights_um)


def encode_json(heights_um: FloatArray) -> dict[str, float]:
    """Encode the pixels with a target and their heights in the form of FRAMES.json."""
    return {str(pixel): float(heights_um[pixel]) for pixel in np.flatnonzero(heights_um).tolist()}


def encode_frame(number: int, heights_um: FloatArray) -> bytes:
    """Encode a streamed frame. Raise InputError for a height that does not fit in 16 bits."""
    tenths = np.rint(um_to_m(heights_um) / HEIGHT_UNIT_M)
    pixel = int(tenths.argmax())
    if tenths[pixel] > TENTHS_UM_MAX:
        expected = f"at most {TENTHS_UM_MAX / 10:g} µm in a stream"
        raise InputError(f"heights_um[{pixel}]", float(heights_um[pixel]), expected, "bad_target")
    return HEADER.pack(MAGIC, number & FRAME_NUMBER_MAX) + tenths.astype("<u2").tobytes()
