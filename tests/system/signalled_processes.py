"""Processes that a test kills or suspends, and the judgement of the end of a command that needs them."""

import os
import signal
from contextlib import contextmanager, suppress

from rig import PATIENT_LEASE_S, is_alive, wait_for

SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
EMITTING_STATES = ("ARMING", "ARMED", "RUNNING", "HOLD")
TICK_US = 100
"""Maximum period of a board's ticks; the simulated board is exact."""


@contextmanager
def signalling():
    """Yield a function that sends a signal to processes, which continue at the end."""
    pids = []

    def send(number, found):
        pids.extend(found)
        for pid in found:
            os.kill(pid, number)

    try:
        yield send
    finally:
        resume(pids)


def resume(pids):
    for pid in reversed(pids):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


def wait_for_end(process):
    """Wait until a command ends and return its stderr."""
    return process.communicate()[1]


def assert_one_line(errors, progress=()):
    """Assert that a command's stderr is one line of its own that states the event, besides lines of progress."""
    lines = [line for line in errors.splitlines() if not line.startswith(tuple(progress))]
    assert len(lines) == 1, errors
    assert lines[0].startswith("optodrive: "), errors
    assert len(lines[0]) > len("optodrive: ") + 20, errors
    return lines[0]


def wait_until_dark(board):
    """Wait until a board that runs has left its armed states, and return the number of its events so far."""
    if is_alive(board.process.pid):
        wait_for(lambda: not any(e["state"] in EMITTING_STATES for e in board.of("state")[-1:]), "a disarmed board")
        assert not any(event["on"] for event in board.of("gate")[-1:])
    return len(board.events())


def assert_stayed_dark(board, begin):
    """Assert that a board lit nothing from an event on, once all that could light it has ended."""
    assert not [event for event in board.events()[begin:] if event["event"] == "gate" and event["on"]]


def assert_dark_within_lease(board, lease_s=PATIENT_LEASE_S):
    """Assert, in the board's own time, that its gate is off from the end of the last lease that it received."""
    leases, gates = board.all_of("lease"), board.of("gate")
    if gates:
        assert gates[-1]["on"] is False
        assert leases[-1]["until_us"] - leases[-1]["t_us"] <= lease_s * 1e6
        assert gates[-1]["t_us"] <= leases[-1]["until_us"] + TICK_US
