"""Picture of a display: one square per pixel, brighter for larger heights, with a scale."""

import io

from PIL import Image, ImageDraw, ImageFont

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import PixelLayout

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


def _draw_scale(draw: ImageDraw.ImageDraw, top: int, max_um: float) -> None:
    font = ImageFont.load_default(13)  # it has no µ
    for k in range(100):
        draw.rectangle((MARGIN_PX + 16 + k, top, MARGIN_PX + 17 + k, top + 10), fill=interpolate_colour(k / 99))
    draw.text((MARGIN_PX, top - 3), "0", font=font, fill=TEXT_COLOUR)
    draw.text((MARGIN_PX + 124, top - 3), f"{max_um:.1f} micrometres", font=font, fill=TEXT_COLOUR)
