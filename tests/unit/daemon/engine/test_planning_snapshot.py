"""Where a running stream is cut for a newer frame."""

from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine.active_plan import ThermalEstimate
from optodrive.daemon.engine.plan_making import PlanningRequest, PlanningSnapshot, build_cut_snapshot, make_plan
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.link.board_setup import build_scales

DISPLAY = DISPLAYS["display-1511"]
DISPLAY = replace(
    DISPLAY, budget=DISPLAY.budget._replace(caps=DISPLAY.budget.caps._replace(galvo_rad2_per_s4=6e4**2))
)  # at the shipped cap the mirrors need no pause
SCALES = build_scales(DISPLAY.config)
START_S = 7.0


@pytest.fixture(scope="module")
def running():
    """Return the plan of a frame that the mirrors cannot draw without pauses."""
    sequence = FrameSequence((TactileFrame("f", 0.0, 60.0, np.full(len(DISPLAY.layout), 20e-6)),))
    built = BuiltRequest(sequence)
    thermal = ThermalEstimate(*DISPLAY.build_cold_state())
    snapshot = PlanningSnapshot(thermal, START_S, thermal)
    request = PlanningRequest(lambda: built, Push("f", {}, 0.0, 0, streamed=True))
    return make_plan(DISPLAY, SCALES, request, built, snapshot, "p1", lambda fraction: None)


def cut(running, at_s, may_withdraw=False):
    plan = replace(running, holds_first=may_withdraw)
    return build_cut_snapshot(plan, plan.before, START_S + at_s, DISPLAY.budget, SCALES[0].tick_s)


@pytest.mark.parametrize("at_s", [-0.01, 0.0])
def test_a_plan_that_may_be_withdrawn_is_cut_where_it_begins(running, at_s):
    for initial_pixels in ((17,), None):
        plan = replace(running, initial_pixels=initial_pixels)
        snapshot = cut(plan, at_s, may_withdraw=True)
        assert (snapshot.cut.kept_points, snapshot.cut.row) == ([0], 0)
        assert (snapshot.start_s, snapshot.initial_pixels, snapshot.cycle) == (START_S, initial_pixels, running.cycle)
        assert np.array_equal(snapshot.before.budget.mirror_rad, running.before.budget.mirror_rad)
        first = cut(running, at_s)
        assert first.cut.row == 1
        assert first.initial_pixels == (int(running.planned.plan.pixel[0]),)
    assert cut(running, 1e-6, may_withdraw=True).cut == cut(running, at_s).cut


def test_within_a_pause_of_the_mirrors_the_pulse_after_it_is_kept(running):
    """Its point begins at the end of the pulse before the pause, and may have left."""
    plan = running.planned.plan
    end_s = plan.start_s + plan.width_s
    pauses = np.flatnonzero(plan.start_s[1:] - end_s[:-1] > 0.009)
    assert len(pauses) > 3
    for row in pauses[:4].tolist():
        snapshot = cut(running, 0.5 * (end_s[row] + plan.start_s[row + 1]))
        assert snapshot.cut.row == row + 2
        assert snapshot.start_s == pytest.approx(START_S + end_s[row + 1])


def test_the_cut_is_at_the_first_end_after_the_stated_time(running):
    plan = running.planned.plan
    end_s = plan.start_s + plan.width_s
    for row in (3, 100, 1000):
        assert cut(running, end_s[row] - 1e-5).cut.row == row + 1
        assert cut(running, end_s[row] + 1e-5).cut.row == row + 2
    assert cut(running, end_s[-1]) is None
