"""The picture of a plan: every pulse at its time and power, every pixel at its place, and both colour schemes."""

from xml.etree import ElementTree

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.cli.main import run
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.planning import plan_picture
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.plan_picture import LEFT, MARGIN, WIDTH, draw_plan
from optodrive.planning.stimuli.pattern_registry import build_pattern

SVG = "{http://www.w3.org/2000/svg}"


def plan(display, name="square", **parameters):
    sequence = build_pattern(name, parameters, display.config)
    return plan_sequence(display, sequence, *display.build_cold_state())


def find(picture, tag, css_class):
    """Return the elements of a class that are drawn, without those of the legend."""
    legend = {item for group in picture.iter(f"{SVG}g") for item in group.iter()}
    return [item for item in picture.iter(SVG + tag) if item.get("class") == css_class and item not in legend]


def test_every_pulse_is_at_its_time_with_its_power(any_display):
    planned = plan(any_display, "pixel", height_um=50, seconds=1.0)
    drawn = plan_picture.draw_plan(planned, any_display)
    bars = find(ElementTree.fromstring(drawn), "rect", "pulse")
    assert len(bars) == len(planned.plan)
    scale = (WIDTH - MARGIN - LEFT) / planned.duration_s
    x = np.array([float(bar.get("x")) for bar in bars])
    assert x == pytest.approx(LEFT + planned.plan.start_s * scale, abs=0.01)
    height = np.array([float(bar.get("height")) for bar in bars])
    assert height == pytest.approx(90.0 * planned.plan.power_w / any_display.config.laser.max_power_w, abs=0.11)


def test_pixels_and_path_are_in_place(display):
    planned = plan(display)
    picture = ElementTree.fromstring(draw_plan(planned, display))
    assert len(find(picture, "rect", "cell")) == len(display.layout)
    assert len(find(picture, "rect", "reached")) == len(set(planned.plan.pixel.tolist()))
    (path,) = find(picture, "polyline", "path")
    points = np.array([point.split(",") for point in path.get("points").split()], dtype=float)
    x_m, y_m = display.layout.x_m[planned.plan.pixel], display.layout.y_m[planned.plan.pixel]
    assert np.corrcoef(points[:, 0], x_m)[0, 1] == pytest.approx(1.0, abs=1e-4)
    assert np.corrcoef(points[:, 1], y_m)[0, 1] == pytest.approx(-1.0, abs=1e-4)


def test_trimmed_pulses_are_marked(display):
    sequence = FrameSequence((), (PulseTrain(3, 0.0, 3.0, 0.04, 0.001, 2.4),))
    planned = plan_sequence(display, sequence, *display.build_cold_state())
    assert 0 < (planned.plan.trimmed_j > 0).sum() < len(planned.plan)
    picture = ElementTree.fromstring(draw_plan(planned, display))
    assert len(find(picture, "rect", "trimmed")) == (planned.plan.trimmed_j > 0).sum()


def test_many_pulses_are_cut_and_said_to_be(display, monkeypatch):
    monkeypatch.setattr(plan_picture, "PULSES_MAX", 10)
    planned = plan(display)
    drawn = draw_plan(planned, display)
    assert f"{len(planned.plan)} pulses in" in drawn
    assert "the first 10 are drawn" in drawn
    assert len(find(ElementTree.fromstring(drawn), "rect", "pulse")) == 10


def test_an_empty_plan_is_drawn(display):
    planned = plan_sequence(display, FrameSequence(), *display.build_cold_state())
    assert not find(ElementTree.fromstring(draw_plan(planned, display)), "rect", "pulse")


def test_the_command_writes_a_picture_in_both_colour_schemes(tmp_path, capsys):
    frames, out = tmp_path / "frames.json", tmp_path / "plan.svg"
    assert run(["patterns", "pixel", "--out", str(frames), "--config", "display-16"]) == 0
    assert run(["plan", str(frames), "--out", str(out), "--config", "display-16"]) == 0
    assert "prefers-color-scheme: dark" in out.read_text()
    assert run(["plan", str(frames), "--out", str(tmp_path / "plan.png")]) == 2
    assert "expected a name that ends in .csv or .svg" in capsys.readouterr().err
    assert DISPLAYS["display-16"].config.name in out.read_text()
