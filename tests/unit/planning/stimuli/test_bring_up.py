"""Waveforms for an oscilloscope: the positions in turn, at a constant rate, and weak."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.stimuli.experiments import WAVEFORMS
from optodrive.planning.stimuli.pattern_registry import build_pattern


def plan_waveform(display, waveform, **parameters):
    sequence = build_pattern("scope", {"waveform": waveform, "seconds": 1.0, **parameters}, display.config)
    planned, report = check_feasibility(display, sequence, *display.build_cold_state(), policy="refuse")
    assert report.fits
    return planned.plan


@pytest.mark.parametrize("waveform", WAVEFORMS)
@pytest.mark.parametrize("name", ["display-16", "display-437", "display-1511"])
def test_a_waveform_fits_and_visits_its_places_in_turn(name, waveform):
    display = DISPLAYS[name]
    plan = plan_waveform(display, waveform)
    assert plan.power_w.max() <= 0.025
    assert np.diff(plan.start_s) == pytest.approx(0.02, abs=2e-3)
    x_m, y_m = display.layout.x_m[plan.pixel], display.layout.y_m[plan.pixel]
    along, across = (y_m, x_m) if waveform.endswith("-y") else (x_m, y_m)
    if waveform == "square":
        assert len(set(plan.pixel.tolist())) == 4
        half_m = np.abs(display.layout.x_m).max()
        assert np.abs(x_m).min() > 0.5 * half_m
        assert (np.sign(x_m[:4]).tolist(), np.sign(y_m[:4]).tolist()) == ([-1, 1, 1, -1], [-1, -1, 1, 1])
        return
    assert np.ptp(across) == 0.0
    if waveform.startswith("steps"):
        assert (np.sign(along[::2]) == -1).all()
        assert along[1::2] == pytest.approx(-along[0], abs=display.config.display.pitch_m)
    else:
        period = len(set(plan.pixel.tolist()))
        assert np.diff(along[:period]) == pytest.approx(display.config.display.pitch_m)
        assert along[period:] == pytest.approx(along[: len(along) - period])


def test_a_display_with_one_pixel_has_no_waveform():
    with pytest.raises(InputError, match="a display with several pixels along it, not display-1"):
        build_pattern("scope", {}, DISPLAYS["display-1"].config)
