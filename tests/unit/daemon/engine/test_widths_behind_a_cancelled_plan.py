"""A plan behind a cancelled one is planned again: its pulses are for the heat that is there, by the board's log."""

import numpy as np
import pytest

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine.queue_state import QueueState
from standing_rig import StandingRig, build_display, build_page

DISPLAY = build_display()
PERIOD_S = 0.1
HEIGHT_ERROR_MAX_M = 1e-6


def find_last_heights_m(rig, count):
    """Return the heights to which the last pulses of a log raise their pixels, from all pulses of the log."""
    scale, layout = rig.remote.scales[0], DISPLAY.layout
    angle = 1.0 / (2.0 * DISPLAY.config.scanner.focal_length_m)
    codes = zip(*(scale.to_codes(at_m * angle).tolist() for at_m in (layout.x_m, layout.y_m)), strict=True)
    pixel_of = {code: pixel for pixel, code in enumerate(codes)}
    events = rig.list_events("pulse")
    pixel = np.array([pixel_of[event["x"], event["y"]] for event in events])
    on_s, off_s = (1e-6 * np.array([event[key] for event in events]) for key in ("on_us", "off_us"))
    power_w = scale.full_power_w / 65535 * np.array([event["duty"] for event in events])
    peaks = DISPLAY.build_cold_heat().apply_pulses(pixel, on_s, off_s - on_s, power_w)
    return peaks.displacement_m[-count:]


def play_behind_a_cancelled_plan(monkeypatch):
    """Cancel a plan of many frames after a few of them. Return the heights of the plan behind it."""
    rig = StandingRig(monkeypatch, DISPLAY).ready()
    rig.arm()
    rig.run(0.02)
    page_m, plans = build_page(DISPLAY, (10, 40, 200), 300.0), []
    for count in (12, 2):
        frames = tuple(TactileFrame(str(k), PERIOD_S * k, PERIOD_S, page_m) for k in range(count))
        plans.append(rig.submit(FrameSequence(frames), rig.remote.epoch).result().plan)
    first, second = (rig.store.find(plan) for plan in plans)
    rig.until(lambda: rig.clock.now_s() > first.start_s + 2.9 * PERIOD_S)  # dark until the next frame
    rig.queue.cancel(first)
    rig.until(lambda: second.has_ended, 10.0)
    assert second.executed_count == 6
    return find_last_heights_m(rig, 6)


def test_its_pulses_reach_their_heights(monkeypatch):
    assert play_behind_a_cancelled_plan(monkeypatch) == pytest.approx(300e-6, abs=HEIGHT_ERROR_MAX_M)


def test_widths_for_the_heat_of_the_cancelled_plan_are_caught(monkeypatch):
    """Mutant: the plan is not planned again."""
    cancel = QueueState.cancel
    monkeypatch.setattr(QueueState, "cancel", lambda *arguments: cancel(*arguments).hold(None))
    heights_m = play_behind_a_cancelled_plan(monkeypatch)
    assert heights_m.min() < 300e-6 - 2.0 * HEIGHT_ERROR_MAX_M
