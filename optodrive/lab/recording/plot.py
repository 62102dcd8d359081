"""A picture of a recording: one row a run, one column a signal, over the pulses that drove it."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.files import written_whole
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording.storage import SIGNALS

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

RUNS_MAX = 400
"""Runs drawn; a taller picture than theirs is opened by few programs."""
NAME_WIDTH, LABEL_WIDTH, PANEL_WIDTH, GAP, HEAD_HEIGHT = 170, 70, 360, 14, 30
HEIGHT_MIN, HEIGHT_MAX, HEIGHT_ALL = 44, 150, 8000
PAPER, INK, FAINT, LIGHT, CURVE, MISSING = "#ffffff", "#222222", "#888888", "#ffe3b0", "#1f5fa8", "#c02020"


def write_picture(path: Path, measurement: Measurement) -> int:
    """Write the picture, a PNG, whole or not at all; how many runs it shows, the first `RUNS_MAX` at most."""
    if path.suffix.lower() != ".png":
        raise InputError(str(path), path.suffix, "a name that ends in .png")
    with np.errstate(over="ignore"):  # a pulse may end beyond the largest number
        image, count = _draw(measurement)
    with written_whole(path) as temporary, temporary.open("wb") as file:
        image.save(file, format="PNG")
    return count


def _draw(measurement: Measurement) -> tuple[Any, int]:
    from PIL import Image, ImageDraw

    runs = measurement.runs[:RUNS_MAX]
    columns = [name for name in SIGNALS if any(name in run.signals for run in runs)]
    height = int(np.clip(HEIGHT_ALL // len(runs), HEIGHT_MIN, HEIGHT_MAX))
    size = (_panel_left(len(columns)), HEAD_HEIGHT + len(runs) * height)
    image = Image.new("RGB", size, PAPER)
    pen = ImageDraw.Draw(image)
    pen.text((GAP, 8), _title(len(runs), len(measurement.runs)), fill=FAINT)
    for column, name in enumerate(columns):
        pen.text((_panel_left(column), 8), name, fill=INK)
    for row, run in enumerate(runs):
        _draw_run(pen, run, columns, HEAD_HEIGHT + row * height, height - GAP)
    return image, len(runs)


def _panel_left(column: int) -> int:
    return NAME_WIDTH + LABEL_WIDTH + column * (PANEL_WIDTH + GAP + LABEL_WIDTH)


def _title(drawn: int, count: int) -> str:
    return f"{count} runs" if drawn == count else f"{drawn} of {count} runs"


def _draw_run(pen: "ImageDraw", run: Run, columns: list[str], top: int, height: int) -> None:
    pen.text((GAP, top), _short(run.name), fill=INK)
    pen.text((GAP, top + 14), _short(str(run.attributes.get("group", ""))), fill=FAINT)
    for column, name in enumerate(columns):
        if name in run.signals:
            left = _panel_left(column)
            _draw_panel(pen, run.signals[name], run.pulses, (left, top, left + PANEL_WIDTH, top + height))


def _short(text: str) -> str:
    # The font that Pillow brings has Latin letters only; a run of another script keeps its place in the order.
    text = text.encode("latin-1", "replace").decode("latin-1")
    return text if len(text) <= 24 else f"{text[:23]}~"


def _draw_panel(pen: "ImageDraw", signal: Signal, pulses: FloatArray, box: tuple[int, int, int, int]) -> None:
    left, top, right, bottom = box
    on_s, off_s = pulses[:, 0], pulses[:, 0] + pulses[:, 1]
    lit = (pulses[:, 3] == signal.pixel) & (off_s >= signal.t_s[0]) & (on_s <= signal.t_s[-1])
    edges = left + (right - left) * _share(np.column_stack([on_s, off_s])[lit], signal.t_s[0], signal.t_s[-1])
    for x_on, x_off in edges.tolist():
        pen.rectangle((x_on, top, max(x_off, x_on + 1), bottom), fill=LIGHT)
    pen.rectangle(box, outline=FAINT)
    there = np.isfinite(signal.value)
    least, most = signal.value[there].min(), signal.value[there].max()
    x = np.round(left + (right - left) * _share(signal.t_s, signal.t_s[0], signal.t_s[-1])).astype(np.int64)
    y = bottom - 1 - (bottom - top - 2) * _share(signal.value, least, most)
    _draw_curve(pen, x, y, there)
    for gone in np.unique(x[~there]).tolist():
        pen.line((gone, bottom - 3, gone, bottom), fill=MISSING)
    pen.text((left - 4, top), f"{most:.4g}", fill=FAINT, anchor="ra")
    pen.text((left - 4, bottom - 11), f"{least:.4g}", fill=FAINT, anchor="ra")
    pen.text((right - 3, top + 1), f"{signal.t_s[-1]:.4g} s", fill=FAINT, anchor="ra")


def _share(values: FloatArray, least: float, most: float) -> FloatArray:
    """Where values lie between two others, 0 to 1. Halves, as a difference of the largest numbers is none."""
    span = most / 2 - least / 2
    if not span > 0:
        return np.full(values.shape, 0.5)
    return np.asarray(np.clip((values / 2 - least / 2) / span, 0.0, 1.0))


def _draw_curve(pen: "ImageDraw", x: Any, y: FloatArray, there: Any) -> None:
    """A line through the samples, broken where one is missing: for each column of the picture first, extremes, last."""
    edges = np.flatnonzero(np.diff(there.astype(np.int8))) + 1
    for part in np.split(np.arange(len(x)), edges):
        if not there[part[0]]:
            continue
        starts = np.flatnonzero(np.diff(x[part], prepend=-1))
        ends = np.append(starts[1:], len(part)) - 1
        lowest, highest = (pick.reduceat(y[part], starts) for pick in (np.minimum, np.maximum))
        levels = np.column_stack([y[part][starts], lowest, highest, y[part][ends]])
        points = np.column_stack([np.repeat(x[part][starts], 4), levels.reshape(-1)])
        if len(part) == 1:
            pen.point(tuple(points[0]), fill=CURVE)
        else:
            pen.line([tuple(point) for point in points.tolist()], fill=CURVE)
