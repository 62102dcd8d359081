"""Dots under fingers are drawn in time, by the board's log and the true places of the fingers, in virtual time."""

import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))
import bench_fingers

from finger_judge import Touch, build_pulses, judge
from optodrive.core.types.fingers import FingerPlace
from optodrive.daemon.engine import page_refresh, plan_queue
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from standing_rig import StandingRig

HEIGHT_UM, RADIUS_M = 50.0, 0.005
TRACKER_HZ, AGE_S, NOISE_M = 100.0, 0.01, 3e-4
SETTLED_S = 1.0
"""Time after which the light counts: the first fingers land on a page that is not drawn yet."""
PLANNING_S, LEAD_S = 0.005, 0.02
PHASES_S = (0.0, 0.0025, 0.005, 0.0075, 0.0125, 0.01875)


def build_display():
    config = load_config("display-1511")
    board = config.board.model_copy(update={"stream_lead_s": LEAD_S})
    return DisplayModel.from_config(config.model_copy(update={"board": board}))


DISPLAY = build_display()
BRAILLE_UM, BRAILLE_LINES = bench_fingers.build_page(DISPLAY, 5)


def rest_fingers(at_s):
    return [Touch(k, x_m, 0.0) for k, x_m in enumerate((-0.009, 0.009))]


def read_braille(speed_m_per_s):
    """Return the fingertips of a hand that reads the benchmark's page of braille."""
    return bench_fingers.ReadingHand(BRAILLE_LINES, speed_m_per_s).find_touches


def jump(at_s):
    """Return two fingertips, each of which lands elsewhere every second."""
    numbers = [int(at_s), 500 + int(at_s + 0.5)]
    places = []
    for number in numbers:
        rng = np.random.default_rng(number)
        begin_m, end_m, y_m = BRAILLE_LINES[rng.integers(len(BRAILLE_LINES))]
        places.append((rng.uniform(begin_m, end_m), y_m))
    return [Touch(number, *place) for number, place in zip(numbers, places, strict=True)]


def draw(monkeypatch, raised, find_touches, duration_s, touched_only=False):
    """Let a page stand under fingers that a noisy tracker reports. Return its pulses and the share in time."""
    # Of a link process with real-time priority, as benchmarks have it.
    monkeypatch.setattr(plan_queue, "SHARED_STREAM_LEAD_S", 0.0)
    rig = StandingRig(monkeypatch, DISPLAY).ready()
    rig.planning_s = PLANNING_S
    monkeypatch.setattr(rig.page, "select", partial(rig.page.select, touched_only=touched_only))
    rig.arm()
    rig.run(0.02)
    target_m = np.where(raised & ~DISPLAY.dead, HEIGHT_UM * 1e-6, 0.0)
    begin_s, reports, rng = rig.clock.now_s(), 0, np.random.default_rng(3)
    rig.show(target_m)
    while rig.clock.now_s() < begin_s + duration_s:
        if rig.clock.now_s() >= begin_s + AGE_S + reports / TRACKER_HZ:
            seen_s = reports / TRACKER_HZ
            places = [(touch.number, *(touch[1:] + rng.normal(0.0, NOISE_M, 2))) for touch in find_touches(seen_s)]
            rig.page.update_fingers(begin_s + seen_s, [FingerPlace(*place, RADIUS_M) for place in places])
            rig.fingers_moved = True
            reports += 1
        rig.run()
    assert not rig.refusals
    assert not rig.list_events("fault")
    pulses = build_pulses(rig.list_events("pulse"), 0.0, DISPLAY)
    times_s = begin_s + np.arange(SETTLED_S, duration_s, 0.005)
    share, count = judge(pulses, DISPLAY, target_m, lambda at_s: find_touches(at_s - begin_s), times_s, RADIUS_M)
    assert count > 100
    return pulses._replace(start_s=pulses.start_s - begin_s), share


def find_touched_pixels():
    """Return the pixels under the fingers at rest."""
    layout = DISPLAY.layout
    distances_m = [np.hypot(layout.x_m - touch.x_m, layout.y_m - touch.y_m) for touch in rest_fingers(0.0)]
    return np.flatnonzero(np.minimum(*distances_m) <= RADIUS_M)


def draw_under_rest(monkeypatch, duration_s):
    """Return of the dots under two resting fingers on a raised page the mean rate, Hz, and the share in time."""
    everywhere = np.ones(len(DISPLAY.layout), dtype=bool)
    pulses, share = draw(monkeypatch, everywhere, rest_fingers, duration_s)
    under = find_touched_pixels()
    is_settled = pulses.start_s >= SETTLED_S
    rate_hz = np.count_nonzero(np.isin(pulses.pixel[is_settled], under)) / len(under) / (duration_s - SETTLED_S)
    return rate_hz, share


def test_dots_under_two_resting_fingers_get_24_pulses_per_second_on_a_raised_page(monkeypatch):
    rate_hz, share = draw_under_rest(monkeypatch, 3.0)
    assert rate_hz >= 24.0  # each is due 40 ms after its last pulse, and waits for the one being drawn
    assert share >= 0.95


def test_untouched_dots_are_dark_where_only_touched_ones_are_drawn(monkeypatch):
    braille = BRAILLE_UM > 0.0
    whole, share = draw(monkeypatch, braille, jump, 3.0)
    only, share_only = draw(monkeypatch, braille, jump, 3.0, touched_only=True)
    assert share_only >= share - 0.02
    assert only.energy_j.sum() <= 0.6 * whole.energy_j.sum()
    layout, near = DISPLAY.layout, 0
    for pixel, start_s in zip(only.pixel.tolist(), only.start_s.tolist(), strict=True):
        # A dot is drawn for fingers that are there between their report, and the time for which they are foreseen.
        touches = [touch for at_s in np.arange(start_s - 0.15, start_s + 0.05, 0.01) for touch in jump(max(0.0, at_s))]
        distances_m = [np.hypot(layout.x_m[pixel] - each.x_m, layout.y_m[pixel] - each.y_m) for each in touches]
        near += min(distances_m) <= RADIUS_M + 3.0 * NOISE_M + 1e-3
    assert near >= 0.97 * len(only.pixel)  # of a finger that has just landed the speed is known badly


def test_a_margin_with_the_priority_of_the_fingers_is_caught(monkeypatch):
    """Mutant: dots within the whole margin of a finger's place come first, which are three times as many."""
    monkeypatch.setattr(page_refresh, "MARGIN_SHARE", 1.0)
    rate_hz, share = draw_under_rest(monkeypatch, 2.0)
    assert rate_hz < 20.0
    assert share < 0.95


@pytest.mark.slow
@pytest.mark.parametrize(
    ("find_touches", "share_min"),
    [(read_braille(0.02), 0.977), (read_braille(0.05), 0.968), (read_braille(0.1), 0.94), (jump, 0.93)],
    ids=["2 cm/s", "5 cm/s", "10 cm/s", "jumps"],
)
def test_dots_under_moving_fingers_are_drawn_in_time(monkeypatch, find_touches, share_min):
    """When a finger lands between two reports of the tracker changes the share by a hundredth: the mean is taken."""
    shares = []
    for phase_s in PHASES_S:
        with monkeypatch.context() as patch:
            shares.append(draw(patch, BRAILLE_UM > 0.0, lambda at_s, by_s=phase_s: find_touches(at_s + by_s), 8.0)[1])
    assert np.mean(shares) >= share_min


@pytest.mark.slow
def test_a_page_without_fingers_gets_290_pulses_per_second(monkeypatch):
    rng = np.random.default_rng(1)
    page = np.isin(np.arange(len(DISPLAY.layout)), rng.choice(len(DISPLAY.layout), 385, False))
    target_m = np.where(page, HEIGHT_UM * 1e-6, 0.0)
    rig = StandingRig(monkeypatch, DISPLAY).ready()
    rig.arm()
    rig.run(0.02)
    rig.stand(target_m, 1.0)
    since_s = rig.clock.now_s()
    rig.stand(target_m, 4.0)
    assert len(rig.list_pulses(since_s)) >= 4.0 * 290
