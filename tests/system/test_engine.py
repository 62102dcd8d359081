"""Engine on a simulated board process, in real time."""

import threading

import numpy as np
import pytest

from optodrive.core.errors import StoppedError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from rig import wait_for


def frame(height_um=100.0, pixel=17, duration_s=0.05):
    target = np.zeros(437)
    target[pixel] = height_um * 1e-6
    return FrameSequence((TactileFrame("f", 0.0, duration_s, target),))


def train(seconds):
    return FrameSequence((), (PulseTrain(200, 0.0, seconds, 0.01, 0.01, 1.0),))


def test_a_stalled_planner_lets_the_lease_expire(armed, board):
    hang = threading.Event()
    future = armed.submit_sequence(lambda: hang.wait() and frame(), "hangs")
    wait_for(lambda: armed.board_state == "FAULT", "the lease to expire")
    assert board.of("fault")[-1]["fault"] == "LINK"
    wait_for(lambda: "planner made no progress" in armed.web.status["epoch_reason"], "the cause")
    hang.set()
    with pytest.raises(StoppedError, match="went to FAULT"):
        future.result()


def test_a_busy_planner_keeps_the_lease(armed, board):
    long_one = train(200.0)
    answers = [armed.submit_sequence(long_one, "long") for _ in range(3)]
    for answer in answers:
        assert answer.result().planned == 10_000
    assert armed.board_state == "RUNNING"
    assert not board.of("fault")


def test_a_crash_of_the_loop_aborts_the_board(armed, board, monkeypatch):
    armed.submit_sequence(train(5.0), "long").result()
    wait_for(lambda: len(board.of("pulse")) > 10, "pulses")

    def crash(*_, **__):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(armed.plan_queue, "update_jobs", crash)
    wait_for(lambda: armed.failure, "the crash")
    assert isinstance(armed.failure, ZeroDivisionError)
    wait_for(lambda: board.of("state")[-1]["state"] == "DISARMED", "DISARMED")
    assert board.of("gate")[-1]["on"] is False
    assert board.of("state")[-1]["reason"] == "abort"
