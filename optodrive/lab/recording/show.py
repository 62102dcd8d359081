"""Statistics of the runs of a recording, and its plot with the pulses shaded behind the curves."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optodrive.core.document import to_json
from optodrive.core.files import atomic_write, check_output
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording.storage import SIGNALS

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

RUNS_MAX = 400
"""Maximum number of plotted runs; few programs open a taller image."""
NAME_WIDTH, LABEL_WIDTH, PANEL_WIDTH, GAP, HEAD_HEIGHT = 170, 70, 360, 14, 30
HEIGHT_MIN, HEIGHT_MAX, TOTAL_HEIGHT = 44, 150, 8000
BACKGROUND_COLOUR, TEXT_COLOUR, FRAME_COLOUR = "#ffffff", "#222222", "#888888"
PULSE_COLOUR, CURVE_COLOUR, MISSING_COLOUR = "#ffe3b0", "#1f5fa8", "#c02020"


def build_summary(measurement: Measurement) -> list[dict[str, Any]]:
    """Return statistics of each run in SI units as JSON values."""
    return [_summarize_run(run) for run in measurement.runs]


def _summarize_run(run: Run) -> dict[str, Any]:
    group = run.attributes.get("group")
    with np.errstate(over="ignore"):
        energy_j = float(np.sum(run.pulses[:, 1] * run.pulses[:, 2]))
    return {
        "run": run.name,
        "group": None if group is None else str(group),
        "ambient_K": run.ambient_k,
        "attributes": {key: to_json(value) for key, value in run.attributes.items()},
        "pulses": len(run.pulses),
        "pulsed_pixels": [int(pixel) for pixel in np.unique(run.pulses[:, 3])],
        "energy_J": to_json(energy_j),
        "commands": None if run.commands is None else len(run.commands),
        "signals": {name: _summarize_signal(signal) for name, signal in run.signals.items()},
    }


def _summarize_signal(signal: Signal) -> dict[str, Any]:
    measured = signal.value[np.isfinite(signal.value)]
    return {
        "pixel": signal.pixel,
        "samples": len(signal.t_s),
        "missing": len(signal.t_s) - len(measured),
        "start_s": float(signal.t_s[0]),
        "end_s": float(signal.t_s[-1]),
        "min": float(measured.min()),
        "max": float(measured.max()),
        "sigma": signal.sigma,
    }


def write_plot(path: Path, measurement: Measurement) -> int:
    """Write the plot as a PNG file atomically. Return the number of plotted runs, which is at most `RUNS_MAX`."""
    check_output(str(path), path, ".png")
    with np.errstate(over="ignore"):  # a pulse may end beyond the largest finite number
        image, count = _draw(measurement)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        image.save(file, format="PNG")
    return count


def _draw(measurement: Measurement) -> tuple[Any, int]:
    from PIL import Image, ImageDraw

    runs = measurement.runs[:RUNS_MAX]
    columns = [name for name in SIGNALS if any(name in run.signals for run in runs)]
    height = int(np.clip(TOTAL_HEIGHT // len(runs), HEIGHT_MIN, HEIGHT_MAX))
    size = (_compute_panel_left(len(columns)), HEAD_HEIGHT + len(runs) * height)
    image = Image.new("RGB", size, BACKGROUND_COLOUR)
    draw = ImageDraw.Draw(image)
    shown = "" if len(runs) == len(measurement.runs) else f"{len(runs)} of "
    draw.text((GAP, 8), f"{shown}{len(measurement.runs)} runs", fill=FRAME_COLOUR)
    for column, name in enumerate(columns):
        draw.text((_compute_panel_left(column), 8), name, fill=TEXT_COLOUR)
    for row, run in enumerate(runs):
        _draw_run(draw, run, columns, HEAD_HEIGHT + row * height, height - GAP)
    return image, len(runs)


def _compute_panel_left(column: int) -> int:
    return NAME_WIDTH + LABEL_WIDTH + column * (PANEL_WIDTH + GAP + LABEL_WIDTH)


def _draw_run(draw: "ImageDraw", run: Run, columns: list[str], top: int, height: int) -> None:
    draw.text((GAP, top), _abbreviate(run.name), fill=TEXT_COLOUR)
    draw.text((GAP, top + 14), _abbreviate(str(run.attributes.get("group", ""))), fill=FRAME_COLOUR)
    for column, name in enumerate(columns):
        if name in run.signals:
            left = _compute_panel_left(column)
            _draw_panel(draw, run.signals[name], run.pulses, (left, top, left + PANEL_WIDTH, top + height))


def _abbreviate(text: str) -> str:
    # Pillow's built-in font has Latin letters only; other letters become placeholders.
    text = text.encode("latin-1", "replace").decode("latin-1")
    return text if len(text) <= 24 else f"{text[:23]}~"


def _draw_panel(draw: "ImageDraw", signal: Signal, pulses: FloatArray, box: tuple[int, int, int, int]) -> None:
    left, top, right, bottom = box
    on_s, off_s = pulses[:, 0], pulses[:, 0] + pulses[:, 1]
    is_shown = (pulses[:, 3] == signal.pixel) & (off_s >= signal.t_s[0]) & (on_s <= signal.t_s[-1])
    edges = left + (right - left) * _normalize(np.column_stack([on_s, off_s])[is_shown], signal.t_s[0], signal.t_s[-1])
    for x_on, x_off in edges.tolist():
        draw.rectangle((x_on, top, max(x_off, x_on + 1), bottom), fill=PULSE_COLOUR)
    draw.rectangle(box, outline=FRAME_COLOUR)
    is_finite = np.isfinite(signal.value)
    low, high = signal.value[is_finite].min(), signal.value[is_finite].max()
    x = np.round(left + (right - left) * _normalize(signal.t_s, signal.t_s[0], signal.t_s[-1])).astype(np.int64)
    y = bottom - 1 - (bottom - top - 2) * _normalize(signal.value, low, high)
    _draw_curve(draw, x, y, is_finite)
    for missing_x in np.unique(x[~is_finite]).tolist():
        draw.line((missing_x, bottom - 3, missing_x, bottom), fill=MISSING_COLOUR)
    draw.text((left - 4, top), f"{high:.4g}", fill=FRAME_COLOUR, anchor="ra")
    draw.text((left - 4, bottom - 11), f"{low:.4g}", fill=FRAME_COLOUR, anchor="ra")
    draw.text((right - 3, top + 1), f"{signal.t_s[-1]:.4g} s", fill=FRAME_COLOUR, anchor="ra")


def _normalize(values: FloatArray, low: float, high: float) -> FloatArray:
    """Map values between low and high to 0 to 1. Halved operands avoid overflow of the difference."""
    span = high / 2 - low / 2
    if not span > 0:
        return np.full(values.shape, 0.5)
    return np.asarray(np.clip((values / 2 - low / 2) / span, 0.0, 1.0))


def _draw_curve(draw: "ImageDraw", x: Any, y: FloatArray, is_finite: Any) -> None:
    """Draw a line broken at missing samples.

    It leads through the first, minimum, maximum and last sample per image column.
    """
    edges = np.flatnonzero(np.diff(is_finite.astype(np.int8))) + 1
    for part in np.split(np.arange(len(x)), edges):
        if not is_finite[part[0]]:
            continue
        starts = np.flatnonzero(np.diff(x[part], prepend=-1))
        ends = np.append(starts[1:], len(part)) - 1
        lowest, highest = (pick.reduceat(y[part], starts) for pick in (np.minimum, np.maximum))
        levels = np.column_stack([y[part][starts], lowest, highest, y[part][ends]])
        points = np.column_stack([np.repeat(x[part][starts], 4), levels.reshape(-1)])
        if len(part) == 1:
            draw.point(tuple(points[0]), fill=CURVE_COLOUR)
        else:
            draw.line([tuple(point) for point in points.tolist()], fill=CURVE_COLOUR)
