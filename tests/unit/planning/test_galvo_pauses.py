"""A frame whose moves the mirrors do not bear for so long is drawn with rests, and not with holes."""

from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.limiter.limiter import limit
from optodrive.planning.pipeline import plan_sequence

DISPLAY = DISPLAYS["display-1511"]


def frame(height_um, duration_s=60.0, count=1511):
    target_m = np.zeros(1511)
    target_m[:count] = height_um * 1e-6
    return TactileFrame("f", 0.0, duration_s, target_m)


def bearing(rad_per_s2):
    """The display with another cap on its mirrors."""
    caps = DISPLAY.budget.caps._replace(galvo_rad2_per_s4=rad_per_s2**2)
    return replace(DISPLAY, budget=DISPLAY.budget._replace(caps=caps))


@pytest.mark.parametrize("policy", ["trim", "delay", "refuse"])
def test_every_pixel_of_a_low_frame_is_lit_under_any_policy(policy):
    prepared = plan_sequence(DISPLAY, FrameSequence((frame(20),)), *DISPLAY.build_cold_state(), policy)
    plan = prepared.plan
    assert len(plan) == 1511
    assert (plan.reason == "").all()
    assert prepared.predicted_m == pytest.approx(20e-6, rel=1e-3)
    pauses_s = plan.start_s[1:] - (plan.start_s + plan.width_s)[:-1] - plan.settling_s[1:]
    rests = pauses_s[pauses_s > 1e-5]
    assert rests.sum() == pytest.approx(prepared.galvo_pause_s, abs=1e-6)
    assert rests == pytest.approx(0.1, abs=1e-5)
    assert limit(plan, DISPLAY.build_cold_state()[1], DISPLAY.budget, "refuse")[0].trimmed_j.sum() == 0


def test_a_frame_that_needs_no_rest_gets_none():
    prepared = plan_sequence(DISPLAY, FrameSequence((frame(100),)), *DISPLAY.build_cold_state())
    assert prepared.galvo_pause_s == 0.0
    assert check_feasibility(DISPLAY, FrameSequence((frame(20, 2.0),)), *DISPLAY.build_cold_state())[1].name == "f"


def test_admission_counts_the_rests():
    needed_s = plan_sequence(DISPLAY, FrameSequence((frame(20),)), *DISPLAY.build_cold_state()).duration_s
    assert check_feasibility(DISPLAY, FrameSequence((frame(20, needed_s),)), *DISPLAY.build_cold_state())[1].fits
    assert not check_feasibility(DISPLAY, FrameSequence((frame(20, needed_s - 0.05),)), *DISPLAY.build_cold_state())[
        1
    ].fits


def test_mirrors_that_bear_no_move_at_all_get_no_rest_and_no_light():
    prepared = plan_sequence(bearing(1e3), FrameSequence((frame(20, count=5),)), *DISPLAY.build_cold_state())
    assert prepared.galvo_pause_s == 0.0
    assert set(prepared.plan.reason[prepared.plan.power_w == 0]) == {"galvo_acceleration"}


def test_a_train_keeps_its_times_and_loses_what_the_mirrors_do_not_bear():
    trains = tuple(PulseTrain(pixel, 0.005 * k, 3.0, 0.0002, 0.0098, 1.0) for k, pixel in enumerate((0, 700)))
    plan = plan_sequence(bearing(5e4), FrameSequence((), trains), *DISPLAY.build_cold_state()).plan
    assert set(plan.reason) == {"", "galvo_acceleration"}
    assert plan.start_s == pytest.approx(plan.requested_start_s, abs=1e-3)


def test_a_frame_between_trains_rests_and_the_trains_do_not_wait():
    train = PulseTrain(700, 0.0, 2.0, 0.001, 0.049, 1.0)
    display = bearing(6e4)
    prepared = plan_sequence(display, FrameSequence((frame(20, count=400),), (train,)), *DISPLAY.build_cold_state())
    plan, of_train = prepared.plan, prepared.plan.source == 1
    assert prepared.galvo_pause_s > 0
    assert (plan.power_w[~of_train] > 0).all()
    assert np.count_nonzero(of_train) == 40
