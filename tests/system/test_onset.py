"""The onset of a plan in Unix and monotonic time, against the board's log."""

import time
from pathlib import Path

import pytest

from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.link.session.clock_sync import CLOCK_SPAN_S, DRIFT_MAX
from rig import ended, wait_for

LATE = FrameSequence((), (PulseTrain(17, 0.7, 0.2, 0.01, 0.03, 1.0),))


def find_clock_error_s(engine):
    """Return the uncertainty of the board's clock by the round trip that the link states."""
    return 0.5 * (1e-3 * engine.web.status["stats"]["round_trip_ms"] + DRIFT_MAX * CLOCK_SPAN_S)


def read_gate_on_s(board):
    """Return the host's monotonic time of the first gate on, from the board's log and the zero of its clock."""
    zero_s = float(Path(f"{board.port}.clock").read_text())
    return zero_s + next(event["t_us"] for event in board.of("gate") if event["on"]) * 1e-6


def test_the_onset_is_that_of_the_board_s_log_as_exactly_as_its_clock_is_known(armed, board):
    board.forget()
    before_s, unix_before_s, error_s = time.monotonic(), time.time(), find_clock_error_s(armed)
    submitted = armed.submit_sequence(LATE, "late").result()
    planned = submitted.onset
    assert not planned.executed
    wait_for(lambda: armed.get_plan(submitted.plan).executed, "the first pulse")
    onset = armed.get_plan(submitted.plan).onset
    assert onset.executed
    after_s, unix_after_s, error_s = time.monotonic(), time.time(), max(error_s, find_clock_error_s(armed))
    done, gate_on_s = ended(armed, submitted), read_gate_on_s(board)
    assert done.onset == onset
    assert onset.monotonic_s == pytest.approx(gate_on_s, abs=error_s)
    assert planned.monotonic_s + done.delay_s == pytest.approx(gate_on_s, abs=2 * error_s)
    assert before_s < onset.monotonic_s < after_s
    assert unix_before_s < onset.unix_s < unix_after_s


def test_a_plan_that_ends_before_its_onset_has_none(armed):
    submitted = armed.submit_sequence(LATE, "late").result()
    armed.cancel(submitted.plan).result()
    assert ended(armed, submitted).onset is None
