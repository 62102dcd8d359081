"""Heights of all pixels: the forms in which callers give them, their form on the wire, and a picture of them."""

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optodrive.core.errors import InputError
from optodrive.core.quantity import um_to_m
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FRAME_NUMBER_MAX, HEADER, HEIGHT_UNIT_M, MAGIC
from optodrive.device.config import PixelLayout

if TYPE_CHECKING:
    from PIL import ImageDraw

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


WIDTH_MAX_PX, CELL_MAX_PX = 640, 24
MARGIN_PX, FOOTER_PX = 12, 34
BACKGROUND, TEXT_COLOUR = (24, 26, 33), (222, 226, 234)
COLOUR_STOPS = ((52, 56, 68), (48, 92, 150), (104, 148, 150), (214, 178, 90), (255, 236, 160))
"""From no displacement to the largest; the lightness increases throughout, so that hue is not needed to read it."""


def interpolate_colour(fraction: float) -> tuple[int, int, int]:
    """Return the colour of a fraction of the largest height, 0 to 1."""
    position = min(max(fraction, 0.0), 1.0) * (len(COLOUR_STOPS) - 1)
    index = min(int(position), len(COLOUR_STOPS) - 2)
    low, high = COLOUR_STOPS[index], COLOUR_STOPS[index + 1]
    red, green, blue = (round(a + (b - a) * (position - index)) for a, b in zip(low, high, strict=True))
    return red, green, blue


def render_png(layout: PixelLayout, heights_um: FloatArray) -> bytes:
    """Render heights [p] in µm as PNG. Row 0 is at the bottom, as on the display."""
    rows, columns = int(layout.row.max()) + 1, int(layout.column.max()) + 1
    cell_px = max(4, min(CELL_MAX_PX, WIDTH_MAX_PX // max(columns, rows)))
    size = max(columns * cell_px, 220) + 2 * MARGIN_PX, rows * cell_px + 2 * MARGIN_PX + FOOTER_PX
    # Imported with the first picture: a client that shows none starts earlier without it.
    from PIL import Image, ImageDraw

    image = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(image)
    max_um, gap = float(heights_um.max()), max(1, cell_px // 10)
    for row, column, height_um in zip(layout.row.tolist(), layout.column.tolist(), heights_um.tolist(), strict=True):
        x, y = MARGIN_PX + column * cell_px, MARGIN_PX + (rows - 1 - row) * cell_px
        fill = interpolate_colour(height_um / max_um if max_um else 0.0)
        draw.rectangle((x + gap, y + gap, x + cell_px - gap - 1, y + cell_px - gap - 1), fill=fill)
    _draw_scale(draw, rows * cell_px + 2 * MARGIN_PX, max_um)
    output = io.BytesIO()
    image.save(output, "PNG", optimize=True)
    return output.getvalue()


def _draw_scale(draw: "ImageDraw.ImageDraw", top: int, max_um: float) -> None:
    from PIL import ImageFont

    font = ImageFont.load_default(13)  # it has no µ
    for k in range(100):
        draw.rectangle((MARGIN_PX + 16 + k, top, MARGIN_PX + 17 + k, top + 10), fill=interpolate_colour(k / 99))
    draw.text((MARGIN_PX, top - 3), "0", font=font, fill=TEXT_COLOUR)
    draw.text((MARGIN_PX + 124, top - 3), f"{max_um:.1f} micrometres", font=font, fill=TEXT_COLOUR)
