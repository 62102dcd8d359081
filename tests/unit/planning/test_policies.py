"""A frame that does not fit: trimmed, delayed or refused, as the caller says."""

from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError, OverBudgetError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.planning.pipeline import plan_sequence, resolve_policy
from optodrive.planning.plan_summary import summarize_plan

DISPLAY = DISPLAYS["display-437"]


def colder(**caps):
    """The display with lower caps."""
    return replace(DISPLAY, budget=DISPLAY.budget._replace(caps=DISPLAY.budget.caps._replace(**caps)))


def frames(count, height_m=300e-6, every_s=0.1):
    target = np.zeros(len(DISPLAY.layout))
    target[[200, 201]] = height_m
    return FrameSequence(tuple(TactileFrame(f"f{k}", k * every_s, every_s, target) for k in range(count)))


def test_trim_says_which_pixel_and_when_all_would_fit():
    result = plan_sequence(colder(touch_k=2.0), frames(6), *DISPLAY.build_cold_state())
    figures = summarize_plan(result)
    assert figures.trimmed.by_reason == {"touch_temperature": figures.trimmed.pulses}
    shortfall = figures.shortfall
    assert shortfall.pixel in (200, 201)
    assert shortfall.cap == "touch_temperature"
    assert shortfall.margin_j > 0
    assert 0 < shortfall.fits_after_s < 10


def test_delay_shows_everything_as_tall_as_asked_only_later():
    cold = colder(touch_k=2.0)
    result = plan_sequence(cold, frames(6), *DISPLAY.build_cold_state(), "delay")
    assert not result.plan.trimmed_j.any()
    assert result.predicted_m == pytest.approx(np.full(12, 300e-6), rel=0.02)
    waited = {delay.source: delay for delay in result.delays}
    assert waited
    assert all(delay.cap == "touch_temperature" for delay in waited.values())
    first = result.plan.start_s[result.plan.source == 5][0]
    assert first == pytest.approx(result.lead_in_s + 0.5 + sum(delay.wait_s for delay in result.delays), abs=0.05)


def test_delay_is_no_longer_than_it_must_be():
    cold, state = colder(touch_k=2.0), DISPLAY.build_cold_state()
    early = plan_sequence(cold, frames(6), *state, "delay")
    for delay in early.delays:
        start_s = early.plan.start_s[early.plan.source == delay.source][0]
        before = early.plan.source < delay.source
        assert before.any()
        assert start_s > early.plan.start_s[before][-1]
    shorter = plan_sequence(cold, frames(6), *state, "trim")
    assert shorter.plan.trimmed_j.any()


def test_a_train_waits_pulse_by_pulse():
    cold = colder(touch_k=2.5)
    train = PulseTrain(200, 0.0, 1.0, 0.02, 0.02, 2.45)
    result = plan_sequence(cold, FrameSequence(trains=(train,)), *DISPLAY.build_cold_state(), "delay")
    assert len(result.plan) == 25
    assert not result.plan.trimmed_j.any()
    gaps = np.diff(result.plan.start_s)
    assert gaps[0] == pytest.approx(0.04)  # two pulses fit as they are
    assert gaps[1:].min() > 0.04
    assert gaps[3:] == pytest.approx(gaps[-1], rel=0.05)  # then it goes as fast as the surface cools
    assert [delay.source for delay in result.delays] == [0]


@pytest.mark.parametrize("policy", ["delay", "refuse"])
def test_what_never_fits_is_refused_and_says_so(policy):
    with pytest.raises(OverBudgetError, match="does not fit at any later time") as caught:
        plan_sequence(colder(absorber_k=60.0), frames(1), *DISPLAY.build_cold_state(), policy)
    assert caught.value.cap == "absorber_temperature"


def test_strict_is_refuse_and_contradicts_delay():
    assert resolve_policy("trim", True) == "refuse"
    assert resolve_policy("delay", False) == "delay"
    with pytest.raises(InputError, match="either strict or policy 'delay'"):
        resolve_policy("delay", True)


def test_progress_is_told_within_a_frame_too():
    """A planner that says nothing for long counts as dead, and a frame with terms in its model takes its time."""
    target_m, told = np.full(len(DISPLAY.layout), 50e-6), []
    plan_sequence(
        DISPLAY,
        FrameSequence((TactileFrame("all", 0.0, 9.0, target_m),)),
        *DISPLAY.build_cold_state(),
        on_progress=told.append,
    )
    assert len(told) >= len(target_m) // 16
    assert told == sorted(told)
