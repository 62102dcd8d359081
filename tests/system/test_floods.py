"""No flood of a caller without an arming token darkens a running show or keeps STOP from its effect.

How long STOP takes meanwhile is measured by `scripts/bench stop` and `scripts/bench gate`.
"""

import signal

import pytest

from floods import FLOODS
from rig import read_role_tokens, wait_for
from signalled_processes import signalling
from stop_rig import FloodProcess, StopRig, is_gate_on, is_unarmed

PULSES = (400, 5, 23)
"""Pulses of each show before its STOP."""
EVERY_RUN = (
    ("duplicate keys to patterns", "http"),
    ("idle connections", "http"),
    ("connection churn", "http"),
    ("pings", "http"),
    ("valid previews", "http"),
)
"""The floods whose kind once darkened a show, kept one from beginning, or delayed STOP by seconds."""


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    rig = StopRig(tmp_path_factory.mktemp("floods"))
    yield rig
    rig.close()


def stop(rig, path, begin):
    """Send STOP to the show that began at an event, and return the index of the event that ended it."""
    rig.senders[path]()
    assert rig.find_darkness(begin) == []
    end = next((k for k, event in enumerate(rig.tail.events) if k >= begin and is_unarmed(event)), None)
    assert end is not None, "STOP was answered before the board was disarmed"
    assert not [event for event in rig.tail.events[begin:end] if event["event"] == "gate"][-1]["on"]
    return end


@pytest.mark.parametrize(
    ("name", "path"),
    [
        (name, path) if (name, path) in EVERY_RUN else pytest.param(name, path, marks=pytest.mark.slow)
        for name in FLOODS
        for path in ("http", "socket")
    ],
)
def test_a_show_goes_on_and_STOP_takes_effect(rig, name, path):
    """The last STOP comes while the process that does the flood's work is suspended: STOP waits for none of it."""
    begin = rig.start_show()
    flood = FloodProcess(name, rig.daemon.url, read_role_tokens(rig.daemon))
    try:
        for pulses in PULSES:
            assert rig.watch_show(begin, pulses) == []
            with signalling() as send, flood.triggered():
                if pulses == PULSES[-1]:
                    preview = wait_for(lambda: rig.daemon.find_process("preview"), "the preview process")
                    send(signal.SIGSTOP, [rig.daemon.process.pid, preview])  # the supervisor would replace the other
                end = stop(rig, path, begin)
            begin = rig.start_show()
            assert not any(map(is_gate_on, rig.tail.events[end:begin])), "lit after STOP"
    finally:
        counts = flood.finish()
    rig.senders[path]()
    assert counts
    assert "500" not in counts
    assert "Traceback" not in rig.daemon.errors.read_text()
