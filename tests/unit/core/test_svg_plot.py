"""Plots: ticks at round numbers, units with prefixes, and values at their places."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from optodrive.core.svg_plot import BOTTOM, LEFT, RIGHT, TOP, WIDTH, Axis, Series, draw_plot

HEIGHT = 200


def draw(x, y, unit="m", half_band=0.0, **options):
    x_axis, y_axis = Axis("time", "s"), Axis("height", unit, half_band)
    return ElementTree.fromstring(draw_plot("a <title>", x, x_axis, y_axis, [Series(y, "extended", **options)], HEIGHT))


@pytest.mark.parametrize(
    ("top", "unit", "label", "ticks"),
    [
        (1.2e-4, "m", "height, µm", ["0", "50", "100"]),
        (0.9, "K", "height, K", ["0.0", "0.2", "0.4", "0.6", "0.8"]),
        (2.1e-3, "N", "height, mN", ["0.0", "0.5", "1.0", "1.5", "2.0"]),
        (-40.0, "K", "height, K", ["−40", "−30", "−20", "−10", "0"]),
    ],
)
def test_ticks_are_round_numbers_of_a_readable_unit(top, unit, label, ticks):
    svg = draw(np.linspace(0.0, 0.2, 50), np.linspace(0.0, top, 50), unit)
    texts = [item.text for item in svg.iter("text")]
    assert [item.text for item in svg.iter("text") if item.get("x") == str(LEFT - 5)] == ticks
    assert texts[len(ticks) : -2] == ["0", "50", "100", "150", "200"]
    assert texts[-2:] == ["time, ms", label]


def test_values_are_at_their_places():
    x, y = np.array([0.0, 0.5, 1.0]), np.array([-1.0, 3.0, 1.0])
    svg = draw(x, y, "K")
    points = [tuple(map(float, pair.split(","))) for pair in svg.find("polyline").get("points").split()]
    assert [a for a, _ in points] == [LEFT, (LEFT + WIDTH - RIGHT) / 2, WIDTH - RIGHT]
    marks = {item.text: float(item.get("y")) - 4 for item in svg.iter("text") if item.get("x") == str(LEFT - 5)}
    assert points[0][1] == pytest.approx(marks["−1"], abs=0.1)
    assert points[1][1] == pytest.approx(marks["3"], abs=0.1)
    assert all(TOP <= b <= HEIGHT - BOTTOM for _, b in points)


def test_the_band_and_missing_values():
    svg = draw(np.arange(4.0), np.array([0.0, np.nan, 0.5, -0.5]), "K", half_band=1.0, is_dotted=True)
    assert len(list(svg.iter("circle"))) == 3
    band = svg.find("rect")
    marks = {item.text: float(item.get("y")) - 4 for item in svg.iter("text") if item.get("x") == str(LEFT - 5)}
    assert float(band.get("y")) == pytest.approx(marks["1"], abs=0.1)
    assert float(band.get("y")) + float(band.get("height")) == pytest.approx(marks["−1"], abs=0.2)


@pytest.mark.parametrize("value", [0.0, 5.0, -1e-9, 1e300])
def test_a_constant_is_drawn(value):
    svg = draw(np.array([0.0, 1.0]), np.array([value, value]))
    assert not re.search("nan|inf", ElementTree.tostring(svg).decode())
