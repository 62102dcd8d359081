"""Plots as SVG: lines and dots over time, with axes, ticks and units, in the colours of the page around them."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from math import ceil, floor, log10

import numpy as np

from optodrive.core.quantity import select_scale
from optodrive.core.types.arrays import FloatArray

WIDTH = 420
LEFT, RIGHT, TOP, BOTTOM = 52, 10, 24, 36
"""Margins around the plotted area."""
MAX_TICKS = 5
DOT_RADIUS = 1.8


@dataclass(frozen=True, eq=False)
class Series:
    """Values [n] over the common axis.

    css_class: of its line, or of its dots
    """

    y: FloatArray
    css_class: str
    is_dotted: bool = False


@dataclass(frozen=True)
class Axis:
    """Axis with its quantity and unit, SI.

    half_band: half the width of a band about zero, 0 for none; is_logarithmic: of positive values
    """

    quantity: str
    unit: str
    half_band: float = 0.0
    is_logarithmic: bool = False


class Scale:
    """Map from values to picture coordinates, with ticks at round numbers of the prefixed unit."""

    def __init__(self, axis: Axis, low: float, high: float, start: float, end: float) -> None:
        self._is_logarithmic = axis.is_logarithmic
        if axis.is_logarithmic:
            self._start, self._length, self.label = start, end - start, axis.quantity
            self._low, self._span = log10(low), log10(high / low) or 1.0
            powers = range(floor(log10(low)), ceil(log10(high)) + 1)
            factors = (1.0, 2.0, 5.0) if high < 1000.0 * low else (1.0,)
            round_numbers = [factor * 10.0**power for power in powers for factor in factors]
            self.ticks = [
                (self.place(x), f"{x:g}") for x in round_numbers if low * (1 - 1e-9) <= x <= high * (1 + 1e-9)
            ]
            return
        self._low, self._span, self._start, self._length = low, (high - low) or 1.0, start, end - start
        factor, unit = select_scale(max(abs(low), abs(high)), axis.unit)
        self.label = f"{axis.quantity}, {unit}" if unit not in ("", "1") else axis.quantity
        step = _select_step((high - low) / factor or 1.0)
        numbers = np.arange(ceil(low / factor / step - 1e-9), floor(high / factor / step + 1e-9) + 1) * step
        digits = max(0, -floor(log10(step)))
        self.ticks = [(self.place(number * factor), f"{number + 0.0:.{digits}f}") for number in numbers.tolist()]

    def place(self, value: float) -> float:
        """Return the coordinate of a value."""
        value = log10(value) if self._is_logarithmic else value
        return self._start + (value - self._low) / self._span * self._length

    def place_all(self, values: FloatArray) -> FloatArray:
        """Return the coordinates of values, [n]."""
        values = np.log10(values) if self._is_logarithmic else values
        return self._start + (values - self._low) / self._span * self._length


def draw_plot(title: str, x: FloatArray, x_axis: Axis, y_axis: Axis, series: Sequence[Series], height: int) -> str:
    """Return a plot of series over x [n].

    title: accessible name
    """
    finite = np.concatenate([item.y[np.isfinite(item.y)] for item in series])
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    low, high = min(low, -1.5 * y_axis.half_band), max(high, 1.5 * y_axis.half_band)
    pad = 0.05 * (high - low) or 1e-3 * abs(high) or 1.0
    right, bottom = WIDTH - RIGHT, height - BOTTOM
    x_scale = Scale(x_axis, float(x[0]), float(x[-1]), LEFT, right)
    y_scale = Scale(y_axis, low - pad, high + pad, bottom, TOP)
    return (
        f"<svg viewBox='0 0 {WIDTH} {height}' role='img' aria-label='{escape(title, quote=True)}'>"
        + _draw_band(y_axis.half_band, y_scale, right)
        + _draw_axes(x_scale, y_scale, right, bottom)
        + "".join(_draw_series(x_scale.place_all(x), y_scale.place_all(item.y), item) for item in series)
        + f"<text x='{right}' y='{height - 5}' text-anchor='end'>{escape(x_scale.label)}</text>"
        + f"<text x='4' y='14'>{escape(y_scale.label)}</text></svg>"
    )


def _draw_band(half_band: float, y_scale: Scale, right: int) -> str:
    if half_band == 0.0:
        return ""
    top, bottom = y_scale.place(half_band), y_scale.place(-half_band)
    return f"<rect class='noise' x='{LEFT}' y='{top:.1f}' width='{right - LEFT}' height='{bottom - top:.1f}'/>"


def _draw_axes(x_scale: Scale, y_scale: Scale, right: int, bottom: int) -> str:
    lines = [
        f"<line class='grid-line' x1='{LEFT}' x2='{right}' y1='{y:.1f}' y2='{y:.1f}'/>"
        f"<text x='{LEFT - 5}' y='{y + 4:.1f}' text-anchor='end'>{text.replace('-', '−')}</text>"
        for y, text in y_scale.ticks
    ]
    lines += [
        f"<line class='grid-line' x1='{x:.1f}' x2='{x:.1f}' y1='{TOP}' y2='{bottom}'/>"
        f"<text x='{x:.1f}' y='{bottom + 15}' text-anchor='middle'>{text.replace('-', '−')}</text>"
        for x, text in x_scale.ticks
    ]
    lines.append(f"<line class='axis' x1='{LEFT}' x2='{right}' y1='{bottom}' y2='{bottom}'/>")
    return "".join(lines)


def _draw_series(x: FloatArray, y: FloatArray, series: Series) -> str:
    points = [(a, b) for a, b in zip(x.tolist(), y.tolist(), strict=True) if b == b]
    if series.is_dotted:
        dots = "".join(f"<circle cx='{a:.1f}' cy='{b:.1f}' r='{DOT_RADIUS}'/>" for a, b in points)
        return f"<g class='{series.css_class}'>{dots}</g>"
    return f"<polyline class='{series.css_class}' points='{' '.join(f'{a:.1f},{b:.1f}' for a, b in points)}'/>"


def _select_step(span: float) -> float:
    """Return the round step, 1, 2 or 5 times a power of ten, that divides a span by at most MAX_TICKS."""
    power = 10.0 ** floor(log10(span / MAX_TICKS))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power * MAX_TICKS >= span * (1 - 1e-9))
