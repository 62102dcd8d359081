"""Simultaneous frames: the number of interleaved rounds, and that every pixel still reaches its target."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, TactileFrame
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.plan_summary import summarize_plan
from optodrive.planning.scheduler.interleaving import (
    ROUND_COUNTS,
    CandidateSchedule,
    has_min_gaps,
    select_schedule,
    split_pulses,
)
from optodrive.planning.stimuli.sequence_file import parse_sequence, sequence_to_json
from optodrive.planning.summary_schema import SimultaneitySummary

DISPLAY = DISPLAYS["display-437"]
FOUR = {200: 100, 201: 100, 221: 100, 222: 100}


def frame(heights_um, duration_s=0.5, simultaneous=True, show_at_s=0.0):
    target_m = np.zeros(len(DISPLAY.layout))
    target_m[list(heights_um)] = np.array(list(heights_um.values())) * 1e-6
    return TactileFrame("f", show_at_s, duration_s, target_m, simultaneous)


def plan_frames(*frames, trains=(), display=DISPLAY):
    return plan_sequence(display, FrameSequence(tuple(frames), tuple(trains)), *display.build_cold_state())


def simulate_ratios(result, heights_um):
    """Simulate displacement over target, [times, pixels], from the first pulse to well after the last."""
    plan = result.plan
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w, plan.pixel])
    t_s = np.arange(plan.start_s[0], result.duration_s + 0.03, 5e-5)
    height_um = DISPLAY.build_cold_heat().simulate_traces(pulses, list(heights_um), t_s).displacement_m * 1e6
    return height_um / np.array(list(heights_um.values()))


def test_interleaved_rounds_raise_the_simultaneity_of_four_pixels():
    split, plain = plan_frames(frame(FOUR)), plan_frames(frame(FOUR, simultaneous=False))
    (reported,) = split.simultaneous
    assert reported.interleaved_rounds > 1
    assert len(split.plan) == 4 * reported.interleaved_rounds
    assert simulate_ratios(split, FOUR).min(axis=1).max() == pytest.approx(reported.simultaneity, rel=0.01)
    assert simulate_ratios(plain, FOUR).min(axis=1).max() == pytest.approx(reported.simultaneity_single_pulse, rel=0.01)
    assert reported.simultaneity > 1.15 * reported.simultaneity_single_pulse
    assert reported.extra_s == pytest.approx(split.duration_s - plain.duration_s, abs=1e-6)
    assert not plain.simultaneous


@settings(max_examples=15)
@given(
    st.dictionaries(st.sampled_from([200, 201, 202, 221, 222, 223, 300]), st.floats(20, 300), min_size=1, max_size=7)
)
def test_pixels_with_sub_pulses_reach_their_targets(heights_um):
    result = plan_frames(frame(heights_um, duration_s=2.0))
    assert simulate_ratios(result, heights_um).max(axis=0) == pytest.approx(np.ones(len(heights_um)), rel=0.03)
    last = np.isfinite(result.plan.target_m)
    assert sorted(result.plan.pixel[last]) == sorted(heights_um)
    assert has_min_gaps(result.plan, DISPLAY.scan_head.pulse_gap_s)


def test_an_interleaved_frame_meets_its_deadline_or_is_not_split():
    plain_s = plan_frames(frame(FOUR, simultaneous=False)).duration_s
    roomy, tight, late = (plan_frames(frame(FOUR, duration_s=plain_s + more_s)) for more_s in (0.1, 0.005, -0.01))
    assert roomy.simultaneous[0].interleaved_rounds > tight.simultaneous[0].interleaved_rounds > 1
    assert tight.frames[0].late_s == 0.0
    assert late.simultaneous[0].interleaved_rounds == 1
    assert late.frames[0].late_s > 0.0


def test_sub_pulses_have_no_target_of_their_own():
    result = plan_frames(frame(FOUR))
    reported = summarize_plan(result)
    assert np.isnan(result.plan.target_m[:4]).all()
    assert reported.target_max_um == pytest.approx(100.0)
    assert reported.predicted_max_um == pytest.approx(100.0, rel=0.01)
    split = result.simultaneous[0]
    assert reported.frames[0].simultaneous == SimultaneitySummary(
        interleaved_rounds=split.interleaved_rounds,
        simultaneity=split.simultaneity,
        simultaneity_single_pulse=split.simultaneity_single_pulse,
        extra_s=split.extra_s,
    )
    assert summarize_plan(plan_frames(frame(FOUR, simultaneous=False))).frames[0].simultaneous is None


def test_residual_heat_is_used_and_a_second_frame_is_split_too():
    first, second = frame(FOUR, duration_s=0.06), frame(FOUR, duration_s=0.5, show_at_s=0.06)
    result = plan_frames(first, second)
    assert [item.source for item in result.simultaneous] == [0, 1]
    last = np.isfinite(result.plan.target_m)
    assert result.predicted_m[last] == pytest.approx(np.full(8, 100e-6), rel=0.01)
    assert result.plan.energy_j[result.plan.source == 1].sum() < result.plan.energy_j[result.plan.source == 0].sum()


def test_a_train_keeps_its_times_during_the_rounds():
    train = HeightTrain(30, 0.0, 0.2, 0.01, 20e-6)
    result = plan_frames(frame(FOUR), trains=[train])
    assert result.simultaneous[0].interleaved_rounds > 1
    assert result.train_lateness_max_s < 1e-9
    last = np.isfinite(result.plan.target_m) & (result.plan.source == 0)
    assert result.predicted_m[last] == pytest.approx(np.full(4, 100e-6), rel=0.01)


def test_a_frame_of_one_pixel_is_not_split():
    result = plan_frames(frame({7: 200}))
    assert len(result.plan) == 1
    assert not result.simultaneous


def test_the_last_round_compensates_for_trimmed_sub_pulses():
    caps = DISPLAY.budget.caps._replace(pulse_energy_j=0.0018)
    cold = replace(DISPLAY, budget=DISPLAY.budget._replace(caps=caps))
    result = plan_frames(frame(FOUR), display=cold)
    heat, plan = DISPLAY.build_cold_heat(), result.plan
    last = np.flatnonzero(np.isfinite(plan.target_m))
    assert plan.trimmed_j[: last[0]].any()
    for row in range(len(plan)):
        if row in last:
            periods, duty = heat.solve_pulse(int(plan.pixel[row]), plan.start_s[row], 100e-6, DISPLAY.scan_head.drive)
            requested_j = periods * 2e-4 * duty * DISPLAY.scan_head.drive.max_power_w
            assert plan.energy_j[row] + plan.trimmed_j[row] == pytest.approx(requested_j, rel=1e-6)
        heat.apply_pulse(int(plan.pixel[row]), plan.start_s[row], plan.width_s[row], plan.power_w[row])


def test_sub_pulses_are_whole_periods_and_never_empty():
    assert split_pulses({1: (10, 1.0), 2: (7, 0.9)}, 3) == {1: 3, 2: 2}
    assert split_pulses({1: (10, 1.0), 2: (3, 0.9)}, 3) is None
    assert split_pulses({1: (1, 0.1)}, 1) is not None
    assert ROUND_COUNTS[0] == 1


def test_the_best_candidate_meets_the_deadline_and_has_gaps():
    one, two, four = (CandidateSchedule(k, 0.1 * k, 0.1 * k, True) for k in (1, 2, 4))
    assert select_schedule([one, two, four], 1.0) == four
    assert select_schedule([one, two, four], 0.3) == two
    assert select_schedule([one, two, four], 0.01) == one
    assert select_schedule([one, two, replace(four, has_min_gaps=False)], 1.0) == two


def test_sub_pulses_without_a_gap_are_not_selected():
    wide_gap = replace(DISPLAY, scan_heads=(replace(DISPLAY.scan_head, pulse_gap_s=0.01),))
    two = frame({200: 100, 201: 100})
    assert plan_frames(two).simultaneous[0].interleaved_rounds > 1
    assert plan_frames(two, display=wide_gap).simultaneous[0].interleaved_rounds == 1


def test_simultaneous_is_read_written_and_checked():
    entry = {"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50}, "simultaneous": True}
    once = parse_sequence({"frames": [entry, {**entry, "show_at_s": 1.0, "simultaneous": False}]}, DISPLAY.config, "f")
    again = parse_sequence(sequence_to_json(once), DISPLAY.config, "f")
    assert [item.simultaneous for item in again.frames] == [item.simultaneous for item in once.frames] == [True, False]
    with pytest.raises(InputError, match=r"frames\[0\].simultaneous: got 1, expected true or false"):
        parse_sequence({"frames": [{**entry, "simultaneous": 1}]}, DISPLAY.config, "f")
