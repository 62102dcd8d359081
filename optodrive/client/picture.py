"""A display as a picture: one square a pixel, brighter the taller, with its scale."""

import io

from PIL import Image, ImageDraw, ImageFont

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import PixelLayout

WIDTH_MAX, STEP_MAX = 640, 24
MARGIN, FOOT = 12, 34
DARK, TEXT = (24, 26, 33), (222, 226, 234)
STOPS = ((52, 56, 68), (48, 92, 150), (104, 148, 150), (214, 178, 90), (255, 236, 160))
"""From rest to the tallest; lightness rises throughout, so that it can be read without seeing hues."""


def colour(share: float) -> tuple[int, int, int]:
    """The colour of a share of the tallest, 0 to 1."""
    place = min(max(share, 0.0), 1.0) * (len(STOPS) - 1)
    at = min(int(place), len(STOPS) - 2)
    low, high = STOPS[at], STOPS[at + 1]
    red, green, blue = (round(a + (b - a) * (place - at)) for a, b in zip(low, high, strict=True))
    return red, green, blue


def png(layout: PixelLayout, heights_um: FloatArray) -> bytes:
    """PNG of heights [p] in µm; row 0 is at the bottom, as on the display."""
    rows, columns = int(layout.row.max()) + 1, int(layout.column.max()) + 1
    step = max(4, min(STEP_MAX, WIDTH_MAX // max(columns, rows)))
    size = max(columns * step, 220) + 2 * MARGIN, rows * step + 2 * MARGIN + FOOT
    image = Image.new("RGB", size, DARK)
    draw = ImageDraw.Draw(image)
    tallest_um, gap = float(heights_um.max()), max(1, step // 10)
    for row, column, height_um in zip(layout.row.tolist(), layout.column.tolist(), heights_um.tolist(), strict=True):
        x, y = MARGIN + column * step, MARGIN + (rows - 1 - row) * step
        shown = colour(height_um / tallest_um if tallest_um else 0.0)
        draw.rectangle((x + gap, y + gap, x + step - gap - 1, y + step - gap - 1), fill=shown)
    _draw_scale(draw, rows * step + 2 * MARGIN, tallest_um)
    written = io.BytesIO()
    image.save(written, "PNG", optimize=True)
    return written.getvalue()


def _draw_scale(draw: ImageDraw.ImageDraw, top: int, tallest_um: float) -> None:
    font = ImageFont.load_default(13)  # it has no µ
    for k in range(100):
        draw.rectangle((MARGIN + 16 + k, top, MARGIN + 17 + k, top + 10), fill=colour(k / 99))
    draw.text((MARGIN, top - 3), "0", font=font, fill=TEXT)
    draw.text((MARGIN + 124, top - 3), f"{tallest_um:.1f} micrometres", font=font, fill=TEXT)
