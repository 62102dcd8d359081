"""The times between the pulses of a pixel that a plan or a stream's answer states are those of the board's log."""

import numpy as np
import pytest
from test_queue_follows_board import Log, RecordingQueue

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine import plan_making
from optodrive.planning.summary_schema import PlanSummary
from standing_rig import StandingRig, build_display, build_page

DISPLAY = build_display()
PIXELS = len(DISPLAY.layout)
TICK_ERROR_S = 3e-6
"""Rounding of two starts, each in the plan and on the wire."""
SHARE = 0.05


def begin(monkeypatch):
    rig = StandingRig(monkeypatch, DISPLAY, queue_type=RecordingQueue).ready()
    rig.arm()
    rig.run(0.02)
    return rig


def choose_page(seed, count, height_um):
    return build_page(DISPLAY, np.random.default_rng(seed).choice(PIXELS, count, replace=False), height_um)


def play_repeated(monkeypatch, seed, count, rate_hz, height_um):
    """Play twelve equal frames as a plan. Return its summary, and the intervals of each pixel by the board's log."""
    rig, page_m, period_s = begin(monkeypatch), choose_page(seed, count, height_um), 1.0 / rate_hz
    frames = tuple(TactileFrame(str(k), k * period_s, period_s, page_m) for k in range(12))
    summary = rig.submit(FrameSequence(frames), rig.remote.epoch).result().summary
    rig.until(lambda: not rig.queue.is_busy, 60.0)
    log = Log(rig)
    return summary, {pixel: np.diff(log.starts_s[log.pixels == pixel]) for pixel in np.flatnonzero(page_m)}


def judge_plan(summary, intervals_s, period_s):
    """Compare what a plan states with the log. A pixel that needed no pulse in a frame has a multiple of the period."""
    repeats = summary.repeats
    stated = {each.pixel: each for each in repeats.worst}
    for pixel, interval_s in intervals_s.items():
        multiple = np.maximum(1.0, np.round(interval_s / period_s)) * period_s if summary.skipped else period_s
        difference = np.abs(interval_s - multiple).max() / period_s
        if pixel in stated:
            assert (stated[pixel].min_s, stated[pixel].max_s) == pytest.approx(
                (interval_s.min(), interval_s.max()), abs=TICK_ERROR_S
            )
        elif repeats.off_period == len(stated):
            assert difference <= SHARE + TICK_ERROR_S / period_s
    whole_s = np.concatenate(list(intervals_s.values()))
    assert (repeats.min_s, repeats.max_s) == pytest.approx((whole_s.min(), whole_s.max()), abs=TICK_ERROR_S)
    assert repeats.pixels == len(intervals_s)
    assert (repeats.message is None) == (not stated)
    if stated:
        first = repeats.worst[0]
        assert repeats.message.startswith(f"{repeats.off_period} of {repeats.pixels} pixels ")
        assert f": pixel {first.pixel} is drawn after " in repeats.message


@pytest.mark.parametrize(
    ("seed", "count", "rate_hz", "height_um"),
    [(0, 24, 10, 40.0), (1, 6, 30, 60.0), (2, 4, 50, 40.0), (3, 40, 20, 60.0), (4, 9, 30, 60.0), (5, 1, 60, 150.0)],
)
def test_a_plan_of_frames_that_repeat_states_the_intervals_of_the_log(monkeypatch, seed, count, rate_hz, height_um):
    judge_plan(*play_repeated(monkeypatch, seed, count, rate_hz, height_um), 1.0 / rate_hz)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 140))
def test_random_plans_and_streams_state_the_intervals_of_the_log(monkeypatch, seed):
    rng = np.random.default_rng(seed)
    case = (int(rng.integers(1, 30)), float(rng.uniform(5.0, 100.0)), float(rng.choice([20.0, 60.0, 150.0, 350.0])))
    with monkeypatch.context() as each:
        judge_plan(*play_repeated(each, seed, *case), 1.0 / case[1])
    judge_stream(stream(monkeypatch, seed, *case))


def test_pixels_keep_the_period_of_a_plan_at_thirty_frames_per_second_once_warm(monkeypatch):
    _, intervals_s = play_repeated(monkeypatch, 1, 6, 30, 60.0)
    settled_s = np.concatenate([interval_s[2:] for interval_s in intervals_s.values()])
    assert np.abs(30.0 * settled_s - 1.0).max() < SHARE


def stream(monkeypatch, seed, count, rate_hz, height_um):
    """Stream equal frames for a second. Return the rig."""
    rig, page_m = begin(monkeypatch), choose_page(seed, count, height_um)
    end_s, next_s = rig.clock.now_s() + 1.0, rig.clock.now_s()
    while rig.clock.now_s() < end_s:
        if rig.clock.now_s() >= next_s:
            frame = TactileFrame("f", 0.0, 3600.0, page_m)
            rig.submit(FrameSequence((frame,)), rig.remote.epoch, streamed=True, lists_pulses=False).result()
            next_s += 1.0 / rate_hz
        rig.run()
    rig.until(lambda: not rig.queue.is_busy, 60.0)
    return rig


def judge_stream(rig):
    """Compare what each plan states with the log. Return the number of plans that were judged."""
    log, judged = Log(rig), 0
    pulsed_s = {pixel: log.starts_s[log.pixels == pixel].tolist() for pixel in np.unique(log.pixels).tolist()}
    for run in rig.queue.ended:
        (part,), plan = run.job.parts, run.plan
        reports = part.read_reports(np.arange(part.pulse_count))
        points = part.first_index + part._pulse_points[reports.on_ticks > 0]
        rows = [log.of_index[int(point)] for point in points]
        since_s = []
        for start_s, pixel in zip(log.starts_s[rows].tolist(), log.pixels[rows].tolist(), strict=True):
            since_s += [start_s - max(before)] if (before := [s for s in pulsed_s[pixel] if s < start_s]) else []
        if not since_s:
            continue
        judged += 1
        redrawn = PlanSummary.model_validate_json(plan.record.summary_json).redrawn
        assert redrawn.min_s - TICK_ERROR_S <= min(since_s)
        assert max(since_s) <= redrawn.max_s + TICK_ERROR_S
        if len(rows) == len(plan.planned.plan):
            assert (redrawn.min_s, redrawn.max_s) == pytest.approx((min(since_s), max(since_s)), abs=TICK_ERROR_S)
    return judged


@pytest.mark.parametrize(
    ("seed", "count", "rate_hz", "height_um"), [(0, 6, 20, 60.0), (1, 3, 45, 60.0), (2, 4, 60, 40.0), (3, 20, 30, 60.0)]
)
def test_the_answers_of_a_stream_state_the_intervals_of_the_log(monkeypatch, seed, count, rate_hz, height_um):
    assert judge_stream(stream(monkeypatch, seed, count, rate_hz, height_um)) > 5


def test_intervals_that_forget_the_time_before_the_plan_are_caught(monkeypatch):
    """Mutant."""
    summarize_plan = plan_making.summarize_plan
    monkeypatch.setattr(
        plan_making,
        "summarize_plan",
        lambda planned, feasibility, pulsed_s: summarize_plan(
            planned, feasibility, None if pulsed_s is None else np.minimum(pulsed_s, 0.0) * 0.9
        ),
    )
    with pytest.raises((AssertionError, ValueError)):
        judge_stream(stream(monkeypatch, 1, 3, 45, 60.0))
