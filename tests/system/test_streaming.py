"""Streamed frames: the newest replaces all unsent pulses, and every frame reports its result."""

from itertools import pairwise

import numpy as np
import pytest

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine.planner import FACTOR
from rig import ended, wait_for

RESERVED_S = 1.0
"""Time reserved for planning, so that no plan is late on a busy machine, which would make a pause."""


def frame(pixels, height_um=100.0):
    target = np.zeros(437)
    target[list(pixels)] = height_um * 1e-6
    return FrameSequence((TactileFrame("f", 0.0, 10.0, target),))


def wait_for_pulses(armed, answer, count):
    """Wait until a number of a plan's pulses were executed. Raise AssertionError if the plan has failed."""

    def look():
        report = armed.get_plan(answer.plan)
        assert report.status != "failed", report.error
        return report.executed >= count

    wait_for(look, f"{count} pulses")


def stream(armed, sequence):
    return armed.submit_sequence(sequence, "stream", streamed=True).result()


def reserve(armed, reserved_s=RESERVED_S):
    """Let the planner expect that the next frame takes that long to plan."""
    for _ in range(2):
        armed._planner._planning_time.record(reserved_s / FACTOR)


@pytest.mark.parametrize("reserved_s", [RESERVED_S, pytest.param(None, marks=pytest.mark.slow)])
def test_the_newest_frame_wins_without_a_pause(armed, board, reserved_s):
    """A frame of 85 pixels takes four seconds. A new one follows when a part of the previous one was executed."""
    answers = []
    for k in range(5):
        if reserved_s is not None:
            reserve(armed, reserved_s)
        answers.append(stream(armed, frame(range(85 * k, 85 * k + 85), 500.0 if k < 4 else 60.0)))
        wait_for_pulses(armed, answers[-1], 12)
    records = [ended(armed, answer) for answer in answers]
    assert [record.status for record in records] == ["superseded"] * 4 + ["done"]
    for record in records:
        assert record.executed + record.dropped == record.planned == 85
        assert record.executed_complete
        assert record.latency.first_light_s > record.latency.planned_s > 0
    assert all(10 <= record.executed < 85 for record in records[:4])
    pulses = board.of("pulse")
    assert len(pulses) == sum(record.executed for record in records)
    assert [pulse["index"] for pulse in pulses] == sorted({pulse["index"] for pulse in pulses})
    # One job from START to END: the gate is off for no longer than a move, unless the board waits for points.
    states = board.of("state")
    assert [state["reason"] for state in states].count("start") == 1
    holds_us = [state["t_us"] for state in states if state["state"] == "HOLD"]
    for before, after in pairwise(pulses):
        off_us, on_us = before["off_us"], after["on_us"]
        assert on_us - off_us < 3_000 or any(off_us <= hold_us <= on_us for hold_us in holds_us)


def test_frames_reach_their_targets_in_sequence(armed):
    """With the same pixels in every frame, each plan accounts for the heat of the executed ones.

    After several late attempts a plan would begin as soon as it is ready, on pixels that have cooled meanwhile.
    """
    answers = []
    for height_um in (100.0, 250.0, 120.0, 300.0):
        reserve(armed)
        answers.append(stream(armed, frame(range(60), height_um)))
        wait_for(lambda: armed.get_plan(answers[-1].plan).executed >= 4, "a part of the frame")
    heights = [ended(armed, answer) for answer in answers]
    for record, height_um in zip(heights, (100.0, 250.0, 120.0, 300.0), strict=True):
        simulated_um = np.array(record.executed_pulses.simulated_um)
        assert simulated_um == pytest.approx(height_um, rel=0.01)


def test_an_empty_frame_ends_the_previous_one(armed, board):
    first = stream(armed, frame(range(100), 300.0))  # long beside the time until the next has been planned
    wait_for(lambda: armed.get_plan(first.plan).executed >= 5, "a part of the frame")
    nothing = stream(armed, frame(()))
    assert ended(armed, first).status == "superseded"
    assert ended(armed, nothing).status == "done"
    assert 5 <= len(board.of("pulse")) < 60
    wait_for(lambda: armed.board_state == "ARMED", "the job's end")
    assert ended(armed, stream(armed, frame((3,)))).executed == 1


def test_a_stop_ends_a_stream_and_the_heat_is_kept(armed, board):
    first = stream(armed, frame(range(60), 300.0))
    wait_for(lambda: armed.get_plan(first.plan).executed >= 5, "a part of the frame")
    second = stream(armed, frame(range(60, 120), 300.0))
    armed.stop().result()
    for answer in (first, second):
        assert ended(armed, answer).status in ("stopped", "superseded")
    count = len(board.of("pulse"))
    armed.arm().result()
    assert len(board.of("pulse")) == count
    assert ended(armed, stream(armed, frame(range(60), 300.0))).status == "done"
