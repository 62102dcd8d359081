"""A frame that is planned in parts has the pulses of one that is planned as a whole."""

from dataclasses import fields, replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.planning.limiter.limiter import commit_until, shift_state
from optodrive.planning.pipeline import SequencePlanner, plan_sequence
from optodrive.planning.stimuli.frame_json import stale_pixels_first

FRAMES = 40


def with_low_caps(name):
    """Return a display whose caps trim pulses and make the mirrors pause often."""
    display = DISPLAYS[name]
    caps = display.budget.caps._replace(absorber_k=60.0, galvo_rad2_per_s4=6e4**2)
    return replace(display, budget=display.budget._replace(caps=caps))


def draw_frame(rng, pixels):
    count = int(rng.integers(1, min(400, pixels)))
    target_m = np.zeros(pixels)
    target_m[rng.choice(pixels, count, replace=False)] = rng.uniform(10e-6, 120e-6, count)
    sequence = FrameSequence((TactileFrame("f", 0.0, 3600.0, target_m),))
    return stale_pixels_first(sequence, rng.random(pixels) < 0.5)


def assert_equal_columns(one, other, names, rows=slice(None)):
    for name in names:
        first, second = getattr(one, name)[rows], getattr(other, name)[rows]
        np.testing.assert_array_equal(first, second, err_msg=name)


@pytest.mark.parametrize(
    "display", [DISPLAYS["display-1511"], with_low_caps("display-437")], ids=["display-1511", "low caps"]
)
def test_random_frames_in_parts_are_those_of_the_whole(display):
    rng, (heat, budget) = np.random.default_rng(3), display.build_cold_state()
    trimmed = paused_s = later_parts = 0
    for _ in range(FRAMES):
        sequence, pixels = draw_frame(rng, len(display.pixels)), (int(rng.integers(len(display.pixels))),)
        whole = plan_sequence(display, sequence, heat, budget, initial_pixels=pixels)
        planner = SequencePlanner(display, sequence, heat, budget, initial_pixels=pixels)
        first = planner.plan_until(float(rng.uniform(0.0, 0.15)))
        names = [item.name for item in fields(first.plan) if item.name != "headroom_k"]
        assert_equal_columns(first.plan, whole.plan, names, slice(len(first.plan)))
        if not planner.is_complete:
            planner.plan_until(first.duration_s + float(rng.uniform(0.0, 0.1)))
        planned = planner.plan_until()
        assert planner.is_complete
        assert_equal_columns(planned.plan, whole.plan, [*names, "headroom_k"])
        assert planned.skipped == whole.skipped
        assert planned.frames == whole.frames
        assert planned.galvo_pause_s == pytest.approx(whole.galvo_pause_s, abs=1e-12)  # a sum in another order
        np.testing.assert_array_equal(planned.predicted_m, whole.predicted_m)
        for item in fields(whole.budget):
            np.testing.assert_array_equal(getattr(planned.budget, item.name), getattr(whole.budget, item.name))
        trimmed += int(np.count_nonzero(whole.plan.trimmed_j))
        paused_s += whole.galvo_pause_s
        later_parts += len(first.plan) < len(whole.plan)
        cut_s = 0.05 + float(rng.uniform(0.0, 0.05))  # the next frame truncates this one
        kept = whole.plan.start_s < cut_s
        if kept.any():
            columns = (getattr(whole.plan, name)[kept] for name in ("pixel", "start_s", "width_s", "power_w"))
            heat.apply_pulses(*columns)
            end_s = float((whole.plan.start_s + whole.plan.width_s)[kept].max())
            heat = heat.copy_shifted(-end_s)
            budget = shift_state(commit_until(whole.plan, cut_s, budget, display.budget), -end_s)
    assert later_parts > 0.8 * FRAMES
    assert paused_s > 0.0
    assert trimmed > 0 or display is DISPLAYS["display-1511"]


def test_a_part_ends_with_the_first_pulse_that_ends_at_its_time():
    rng, display = np.random.default_rng(5), DISPLAYS["display-1511"]
    sequence = draw_frame(rng, len(display.pixels))
    whole = plan_sequence(display, sequence, *display.build_cold_state()).plan
    end_s = whole.start_s + whole.width_s
    for until_s in (0.0, float(end_s[4]) - 1e-6, float(end_s[4]) + 1e-6):
        planner = SequencePlanner(display, sequence, *display.build_cold_state())
        part = planner.plan_until(until_s).plan
        assert len(part) == np.searchsorted(end_s, until_s) + 1
    assert len(planner.plan_until(until_s).plan) == len(part) + 1
