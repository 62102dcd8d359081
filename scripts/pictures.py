"""Draw a line of braille on the 437-pixel display, with heights computed from the pulses of the simulated board."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from optodrive.device.config_file import load_config
from optodrive.link.simulator.true_display import compute_traces
from optodrive.link.simulator.virtual_run import execute
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.stimuli.pattern_registry import build_pattern

OUT = Path(__file__).parent.parent / "docs" / "pictures"
SCALE = 22
MARGIN = 46
DARK, COLD, WARM, TEXT, GRID = (24, 26, 33), (52, 56, 68), (255, 178, 64), (222, 226, 234), (70, 74, 88)


def mix_colours(share):
    """Return the colour between COLD and WARM."""
    return tuple(round(a + (b - a) * share) for a, b in zip(COLD, WARM, strict=True))


def draw_display(draw, font, layout, height_um, origin):
    """Draw the display with one disc per pixel, and its colour scale."""
    radius = 0.40 * SCALE
    for index in range(len(layout)):
        x = origin[0] + layout.column[index] * SCALE
        y = origin[1] + (layout.row.max() - layout.row[index]) * SCALE
        share = min(1.0, height_um[index] / height_um.max())
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=mix_colours(share))
    draw.text(
        (origin[0] - 8, origin[1] + 21 * SCALE), "437 pixels, “tactile” in braille: peak height", font=font, fill=TEXT
    )
    for k in range(120):
        draw.rectangle(
            (origin[0] + 220 + k, origin[1] + 21 * SCALE + 26, origin[0] + 221 + k, origin[1] + 21 * SCALE + 36),
            fill=mix_colours(k / 119),
        )
    draw.text((origin[0] + 200, origin[1] + 21 * SCALE + 22), "0", font=font, fill=TEXT)
    draw.text(
        (origin[0] + 350, origin[1] + 21 * SCALE + 22), f"{height_um.max():.0f} micrometres", font=font, fill=TEXT
    )


def draw_trace(draw, font, pixel_trace, pulses, box):
    """Draw height, absorber rise and pulses of one pixel over time."""
    left, top, right, bottom = box
    time, height_um, temperature = pixel_trace.t_s, pixel_trace.displacement_m[:, 0] * 1e6, pixel_trace.absorber_k[:, 0]
    end_s, height_max_um, rise_max_k = time[-1], height_um.max() * 1.1, temperature.max() * 1.1

    def compute_x(t_s):
        return left + (right - left) * t_s / end_s

    for share in (0.0, 0.5, 1.0):
        y = bottom - (bottom - top) * share / 1.1
        draw.line((left, y, right, y), fill=GRID)
        draw.text((left - 40, y - 8), f"{share * height_um.max():.0f}", font=font, fill=TEXT)
    for start_s, width_s in pulses:
        draw.rectangle((compute_x(start_s), bottom, compute_x(start_s + width_s) + 1, bottom + 8), fill=(96, 140, 255))
    for values, value_max, colour in ((temperature, rise_max_k, (220, 90, 90)), (height_um, height_max_um, WARM)):
        points = [(compute_x(t), bottom - (bottom - top) * v / value_max) for t, v in zip(time, values, strict=True)]
        draw.line(points, fill=colour, width=3)
    draw.text((left, top - 26), "one of its pixels: height in micrometres", font=font, fill=WARM)
    draw.text((left + 290, top - 26), f"absorber rise, up to {temperature.max():.0f} K", font=font, fill=(220, 90, 90))
    draw.text((left, bottom + 14), "laser pulses", font=font, fill=(96, 140, 255))
    draw.text((right - 60, bottom + 14), f"{end_s:.2f} s", font=font, fill=TEXT)


def main():
    display = DisplayModel.from_config(load_config("display-437"))
    planned_sequence = plan_sequence(
        display, build_pattern("text", {"text": "tactile", "seconds": 0.4}, display.config), *display.build_cold_state()
    )
    executed = execute(display, planned_sequence)
    columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    peaks_um = np.zeros(len(display.layout))
    np.maximum.at(peaks_um, executed.pixel, 1e6 * display.build_cold_heat().apply_pulses(*columns).displacement_m)
    pixel = int(executed.pixel[0])
    is_of_pixel = executed.pixel == pixel
    image = Image.new("RGB", (2 * MARGIN + 21 * SCALE + 560, 2 * MARGIN + 21 * SCALE + 24), DARK)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(16)
    draw_display(draw, font, display.layout, peaks_um, (MARGIN, MARGIN))
    pulses = list(zip(executed.start_s[is_of_pixel], executed.width_s[is_of_pixel], strict=True))
    box = (MARGIN + 21 * SCALE + 70, MARGIN + 40, image.width - MARGIN, image.height - MARGIN - 40)
    draw_trace(draw, font, compute_traces(display.build_cold_heat(), executed, [pixel], 5e-4), pulses, box)
    OUT.mkdir(parents=True, exist_ok=True)
    image.save(OUT / "braille.png", optimize=True)
    print(f"written {OUT / 'braille.png'}")


if __name__ == "__main__":
    main()
