"""Somebody sets the computer's clock while light is emitted: nothing that emits, ends or limits depends on it."""

import itertools
import time

import pytest

from link_service_rig import OPERATOR
from optodrive.daemon.server.listeners import _TIMESPEC, SO_TIMESTAMPNS, TimedSocket
from planner_rig import PlannerRig, build_frame, build_train

STEPS_S = (0.0, 86_400.0, -86_400.0, 3600.0, -1e9, 0.5, -0.5)


def play(monkeypatch):
    """Play a train and a frame, pause and stop. Return the board's log and the states of the plans."""
    rig = PlannerRig(monkeypatch).ready()
    rig.arm()
    rig.run(0.01)
    records = [rig.store.find(rig.submit(build_train(0.5), rig.remote.epoch).result().plan)]
    rig.until(lambda: records[0].status == "done")
    records.append(rig.store.find(rig.submit(build_frame(), rig.remote.epoch).result().plan))
    rig.run(0.3)
    rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))
    rig.run(0.1)
    return rig.log, [(record.status, record.error) for record in records]


def test_a_clock_that_is_set_at_every_reading_changes_nothing(monkeypatch):
    expected = play(monkeypatch)
    assert any(event["event"] == "pulse" for event in expected[0])
    honest_s, steps = time.time, itertools.cycle(STEPS_S)
    monkeypatch.setattr(time, "time", lambda: honest_s() + next(steps))
    monkeypatch.setattr(time, "time_ns", lambda: round(1e9 * time.time()))
    assert play(monkeypatch) == expected


@pytest.mark.parametrize("step_s", STEPS_S)
def test_an_arrival_is_never_later_than_its_reading(monkeypatch, step_s):
    """A frame that seems to have come earlier is refused after a STOP. One that seems later would be shown."""
    now_ns = time.time_ns()
    ancillary = [(1, SO_TIMESTAMPNS, _TIMESPEC.pack(*divmod(now_ns, 10**9)))]
    monkeypatch.setattr(TimedSocket, "recvmsg", lambda *_: (b"x", ancillary, 0, None))
    monkeypatch.setattr(time, "time_ns", lambda: now_ns + round(1e9 * step_s))
    with TimedSocket() as sock:
        assert sock.recv(1) == b"x"
        assert sock.received_s <= time.monotonic()
