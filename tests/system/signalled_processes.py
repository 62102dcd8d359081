"""Processes that a test kills or suspends, and the judgement of the end of a command that needs them."""

import os
import signal
import subprocess
import time
from contextlib import contextmanager, suppress

from rig import is_alive, wait_for

END_S = 5.0
"""Longest time from a fault to the end of the command; the product's own bounds add up to 3.5 s."""
GIVE_UP_S = 40.0
SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
EMITTING_STATES = ("ARMING", "ARMED", "RUNNING")


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
    """Return the time until a command ends, s, and its stderr; kill one that does not end."""
    began_s = time.monotonic()
    try:
        _, errors = process.communicate(timeout=GIVE_UP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    return time.monotonic() - began_s, errors


def assert_one_line(errors, progress=()):
    """Assert that a command's stderr is one line of its own that says what happened, besides lines of progress."""
    lines = [line for line in errors.splitlines() if not line.startswith(tuple(progress))]
    assert len(lines) == 1, errors
    assert lines[0].startswith("optodrive: "), errors
    assert len(lines[0]) > len("optodrive: ") + 20, errors
    return lines[0]


def assert_stays_dark(board):
    """Assert that a board is dark, or is within a second of being resumed, and stays so."""
    if not is_alive(board.process.pid):
        return
    wait_for(lambda: not any(event["on"] for event in board.of("gate")[-1:]), "dark", 3.0)
    wait_for(lambda: not any(e["state"] in EMITTING_STATES for e in board.of("state")[-1:]), "a disarmed board", 3.0)
    pulses = len(board.of("pulse"))
    time.sleep(0.3)
    assert len(board.of("pulse")) == pulses
