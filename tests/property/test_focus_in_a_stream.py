"""While the gate is on the whole focus lies on the absorber when plans of a stream replace each other at any time."""

from dataclasses import replace

import numpy as np
import pytest
from test_focus_on_absorber import PLACES, ROUNDING_M, with_servo

from displays import DISPLAYS
from focus_judge import compute_overhang_m
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine import plan_making
from optodrive.daemon.engine.active_plan import ThermalEstimate
from optodrive.daemon.engine.plan_making import PlanningRequest, PlanningSnapshot, build_cut_snapshot, make_plan
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.link.board_setup import build_board_requirements, build_scales

NAME, PLANS = "display-437", 200
STREAM = Push("frame", {}, 0.0, 0, streamed=True, lists_pulses=False)


def make(display, rng, snapshot):
    """Plan a frame of few dots, of which the first is due a while after the plan's begin."""
    target_m = np.zeros(len(display.layout))
    target_m[rng.choice(len(target_m), int(rng.integers(1, 12)), replace=False)] = 30e-6
    late_s = float(rng.choice([0.0, 0.01]))
    built = BuiltRequest(FrameSequence((TactileFrame("f", late_s, 3600.0, target_m),)))
    request, scales = PlanningRequest(lambda: built, STREAM), build_scales(display.config)
    return make_plan(display, scales, request, built, snapshot, "p1", lambda fraction: None)


def stream(display, seed):
    """Let plans replace each other. Return the points that are played [n, 5], their pixels, and the plans withdrawn.

    Every second plan comes before the one that it replaces has begun.
    """
    rng, tick_s, withdrawn = np.random.default_rng(seed), build_scales(display.config)[0].tick_s, 0
    thermal = ThermalEstimate(*display.build_cold_state())
    plan = make(display, rng, PlanningSnapshot(thermal, 0.0, thermal))
    tables, pixels = [], []
    for number in range(PLANS):
        plan = replace(plan, holds_first=number > 0)
        after_s = rng.uniform(0.0, 0.6) * plan.record.duration_s if number % 2 == 0 else -0.001
        min_start_s = plan.record.start_s + after_s
        snapshot = build_cut_snapshot(plan, thermal, min_start_s, display.budget, tick_s)
        if snapshot is None:  # it is too late for another plan
            continue
        (points,), (kept,) = plan.points.stages, snapshot.cut.kept_points
        tables.append(points.table[:kept])
        pixels.append(plan.planned.plan.pixel[points.row[:kept]])
        withdrawn += kept == 0
        plan = make(display, rng, snapshot)
    return np.concatenate(tables).astype(np.int64), np.concatenate(pixels), withdrawn


def overhang_m(display, table, pixels, place):
    """Return how far the focus extends beyond an absorber's edge while the gate is on, m, with mirrors at a place."""
    scale, (x, y, dark, on, _) = build_board_requirements(display.config).scale, table.T
    begin_s = np.concatenate([[0], np.cumsum(dark + on)[:-1]]) * scale.tick_s
    gate_on = np.flatnonzero(on)
    from_s, on_s = begin_s[gate_on] + dark[gate_on] * scale.tick_s, on[gate_on] * scale.tick_s
    angles_rad = scale.to_angles_rad(x), scale.to_angles_rad(y)
    return compute_overhang_m(with_servo(display, place), begin_s, angles_rad, from_s, on_s, pixels[gate_on])


@pytest.mark.parametrize("seed", range(3))
def test_the_focus_lies_on_the_absorber_in_a_stream(seed):
    display = DISPLAYS[NAME]
    table, pixels, withdrawn = stream(display, seed)
    assert withdrawn >= PLANS // 4
    assert len(pixels) > 150
    assert max(overhang_m(display, table, pixels, place) for place in PLACES) <= ROUNDING_M


def test_mirrors_that_are_taken_for_where_a_withdrawn_plan_would_have_led_are_caught(monkeypatch):
    """Mutant: the mirrors stand at the last pixel of the plan of which nothing was played."""
    find_pixels = plan_making._find_initial_pixels

    def mistake(running, cut):
        return find_pixels(running, cut) if cut.row else (int(running.planned.plan.pixel[-1]),)

    monkeypatch.setattr(plan_making, "_find_initial_pixels", mistake)
    display = DISPLAYS[NAME]
    table, pixels, _ = stream(display, 0)
    assert max(overhang_m(display, table, pixels, place) for place in PLACES) > 1e-4
