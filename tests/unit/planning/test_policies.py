"""Policies for a frame that exceeds a cap: trim, delay or refuse."""

from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import OverBudgetError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.plan_summary import summarize_plan

DISPLAY = DISPLAYS["display-437"]


def with_caps(**caps):
    """Return the display with other caps."""
    return replace(DISPLAY, budget=DISPLAY.budget._replace(caps=DISPLAY.budget.caps._replace(**caps)))


def frames(count, height_m=300e-6, every_s=0.1):
    target = np.zeros(len(DISPLAY.layout))
    target[[200, 201]] = height_m
    return FrameSequence(tuple(TactileFrame(f"f{k}", k * every_s, every_s, target) for k in range(count)))


def test_trim_reports_the_pixel_and_the_delay_after_which_everything_fits():
    result = plan_sequence(with_caps(touch_k=2.0), frames(6), *DISPLAY.build_cold_state())
    summary = summarize_plan(result)
    assert summary.trimmed.by_reason == {"touch_temperature": summary.trimmed.pulses}
    assert summary.limited_by == ["touch_temperature"]
    for share, further in ((0.19, []), (0.21, ["galvo_acceleration"])):  # the mirrors' cap takes time, not power
        paused = summary.model_copy(update={"galvo_pause_s": share * summary.duration_s})
        assert paused.limited_by == [*further, "touch_temperature"]
    shortfall = summary.shortfall
    assert shortfall.pixel in (200, 201)
    assert shortfall.cap == "touch_temperature"
    assert shortfall.margin_j > 0
    assert 0 < shortfall.fits_after_s < 10


def test_delay_reaches_every_target_later():
    capped = with_caps(touch_k=2.0)
    result = plan_sequence(capped, frames(6), *DISPLAY.build_cold_state(), "delay")
    assert not result.plan.trimmed_j.any()
    assert result.predicted_m == pytest.approx(np.full(12, 300e-6), rel=0.02)
    delays = {delay.source: delay for delay in result.delays}
    assert delays
    assert all(delay.cap == "touch_temperature" for delay in delays.values())
    first = result.plan.start_s[result.plan.source == 5][0]
    assert first == pytest.approx(result.lead_in_s + 0.5 + sum(delay.wait_s for delay in result.delays), abs=0.05)


def test_delay_is_no_longer_than_necessary():
    capped, state = with_caps(touch_k=2.0), DISPLAY.build_cold_state()
    early = plan_sequence(capped, frames(6), *state, "delay")
    for delay in early.delays:
        start_s = early.plan.start_s[early.plan.source == delay.source][0]
        before = early.plan.source < delay.source
        assert before.any()
        assert start_s > early.plan.start_s[before][-1]
    shorter = plan_sequence(capped, frames(6), *state, "trim")
    assert shorter.plan.trimmed_j.any()


def test_a_train_is_delayed_pulse_by_pulse():
    capped = with_caps(touch_k=2.5)
    train = PulseTrain(200, 0.0, 1.0, 0.02, 0.02, 2.45)
    result = plan_sequence(capped, FrameSequence(trains=(train,)), *DISPLAY.build_cold_state(), "delay")
    assert len(result.plan) == 25
    assert not result.plan.trimmed_j.any()
    gaps = np.diff(result.plan.start_s)
    assert gaps[0] == pytest.approx(0.04)  # two pulses fit without a delay
    assert gaps[1:].min() > 0.04
    assert gaps[3:] == pytest.approx(gaps[-1], rel=0.05)  # then the rate follows the cooling surface
    assert [delay.source for delay in result.delays] == [0]


@pytest.mark.parametrize("policy", ["delay", "refuse"])
def test_a_frame_that_never_fits_is_refused_with_that_reason(policy):
    with pytest.raises(OverBudgetError, match="does not fit at any later time") as caught:
        plan_sequence(with_caps(absorber_k=60.0), frames(1), *DISPLAY.build_cold_state(), policy)
    assert caught.value.cap == "absorber_temperature"


def test_progress_is_reported_within_a_frame():
    """A planner without progress reports counts as failed, and a frame planned with terms takes long."""
    target_m, reported = np.full(len(DISPLAY.layout), 50e-6), []
    with_term = replace(DISPLAY, parameters=DISPLAY.parameters.model_copy(update={"planner_terms": ("wall_heating",)}))
    plan_sequence(
        with_term,
        FrameSequence((TactileFrame("all", 0.0, 9.0, target_m),)),
        *with_term.build_cold_state(),
        on_progress=reported.append,
    )
    assert len(reported) >= len(target_m) // 16
    assert reported == sorted(reported)
