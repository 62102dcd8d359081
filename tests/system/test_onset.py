"""The onset of a plan in Unix and monotonic time, against the board's log."""

import time
from pathlib import Path

import pytest

from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.daemon.engine.request_body import BuiltRequest
from rig import ended, wait_for

LATE = FrameSequence((), (PulseTrain(17, 0.7, 0.2, 0.01, 0.03, 1.0),))
ERROR_MAX_S = 1e-3


def read_gate_on_s(board):
    """Return the host's monotonic time of the first gate on, from the board's log and the zero of its clock."""
    zero_s = float(Path(f"{board.port}.clock").read_text())
    return zero_s + next(event["t_us"] for event in board.of("gate") if event["on"]) * 1e-6


def test_the_onset_is_that_of_the_board_s_log_within_a_millisecond(armed, board):
    board.forget()
    unix_minus_monotonic_s = time.time() - time.monotonic()
    submitted = armed.submit(lambda: BuiltRequest(LATE), "late").result(10)
    planned = submitted.onset
    assert not planned.executed
    assert planned.monotonic_s - time.monotonic() > 0.3
    wait_for(lambda: armed.get_plan(submitted.plan).executed, "the first pulse")
    onset = armed.get_plan(submitted.plan).onset
    assert onset.executed
    done, gate_on_s = ended(armed, submitted), read_gate_on_s(board)
    assert done.onset == onset
    assert onset.monotonic_s == pytest.approx(gate_on_s, abs=ERROR_MAX_S)
    assert planned.monotonic_s + done.delay_s == pytest.approx(gate_on_s, abs=ERROR_MAX_S)
    for report in (planned, onset):
        assert report.unix_s - report.monotonic_s == pytest.approx(unix_minus_monotonic_s, abs=ERROR_MAX_S)


def test_a_plan_that_ends_before_its_onset_has_none(armed):
    submitted = armed.submit(lambda: BuiltRequest(LATE), "late").result(10)
    armed.cancel(submitted.plan).result(10)
    assert ended(armed, submitted).onset is None
