"""Pauses in the link process, in virtual time: their gate, the collection of the last reports, and their ends."""

import numpy as np
import pytest

from link_service_rig import OPERATOR, PLANNER, STEP_S, WEB, ServiceRig
from optodrive.link.protocol.messages import Executed
from optodrive.link.protocol.states import BoardState
from optodrive.link.service.control import PAUSE_MAX_S
from optodrive.link.service.remote_session import EXECUTED_RECORD
from optodrive.link.session.point_stream import PointDrain
from wire_points import build_points

DUTY = 20_000


@pytest.fixture
def rig():
    return ServiceRig().hello_all().connect().arm()


def command(rig, kind):
    result = rig.await_result(WEB, rig.request(WEB, kind))
    assert result["error"] is None, result
    rig.run()
    return result


def list_reported(rig, number):
    """Return the positions of the points that the planner knows to be executed."""
    positions = set()
    for message in rig.of_kind(PLANNER, "executed"):
        if message.fields["job"] == number:
            first = message.fields["first_point"]
            positions |= set(range(first, first + len(np.frombuffer(message.payload, EXECUTED_RECORD))))
    return positions


def read_drained(rig):
    return [message.fields["pause"] for message in rig.of_kind(PLANNER, "drained")]


def test_a_pause_flushes_and_reports_all_that_was_executed(rig):
    number = rig.begin(build_points(500, DUTY))
    rig.until(lambda: len(rig.list_emitted()) > 40)
    result = command(rig, "pause")
    assert (result["board"]["state"], result["pause"]["number"]) == ("ARMED", 1)
    assert result["pause"]["ends_in_s"] == pytest.approx(PAUSE_MAX_S, abs=0.1)
    emitted = len(rig.list_emitted())
    rig.until(lambda: read_drained(rig) == [1])
    assert list_reported(rig, number) == set(range(emitted))
    rig.run(0.5)
    assert len(rig.list_emitted()) == emitted
    status = rig.of_kind(PLANNER, "status")[-1].fields
    assert (status["is_startable"], status["pause"]["number"], status["epoch"]) == (False, 1, rig.epoch)


def test_points_are_refused_in_a_pause_and_those_of_before_it_afterwards(rig):
    command(rig, "pause")
    rig.begin(build_points(10, DUTY), pause=0)
    rig.begin(build_points(10, DUTY), pause=1)
    command(rig, "resume")
    rig.begin(build_points(10, DUTY), pause=0)
    rig.run(0.3)
    assert rig.list_emitted() == []
    refused = rig.of_kind(PLANNER, "job_refused")
    assert [message.fields["paused"] for message in refused] == [True] * 3
    assert {message.fields["reason"] for message in refused} == {"the light is paused, or was since the plan was made"}
    rig.begin(build_points(10, DUTY), pause=1)
    rig.until(lambda: len(rig.list_emitted()) == 10)


def test_a_splice_is_refused_in_a_pause(rig):
    rig.begin(build_points(200, DUTY), ahead_s=0.04)
    rig.run(0.15)
    rig.request(WEB, "pause")
    _, result = rig.splice(build_points(10, 2 * DUTY), 150, ahead_s=0.04)
    assert result["start_tick"] is None
    assert "paused" in result["error"]["message"]
    assert not rig.find_result(PLANNER, rig.request(PLANNER, "truncate", kept_points=[150]))["done"]


def test_lost_reports_are_requested_again(rig, monkeypatch):
    handlers, lost = rig.session._handlers, []
    record = handlers[Executed]

    def lose_three(message, now_s):
        if len(lost) < 3:
            lost.append(message)
        else:
            record(message, now_s)

    number = rig.begin(build_points(500, DUTY))
    rig.until(lambda: len(rig.list_emitted()) > 40)
    monkeypatch.setitem(handlers, Executed, lose_three)
    rig.until(lambda: len(lost) == 2)
    command(rig, "pause")
    rig.until(lambda: read_drained(rig) == [1])
    assert len(lost) == 3  # the first answer to a request was lost, too
    assert list_reported(rig, number) == set(range(len(rig.list_emitted())))


def test_two_exchanges_without_a_report_or_a_damaged_frame_end_the_collection():
    drain = PointDrain()
    bad_frames = 0
    for stamp, event in enumerate(("", "report", "", "damage", "", "")):
        assert not drain.is_complete
        assert drain.is_due(0.0)
        drain.begin_exchange(stamp, 0.0, bad_frames)
        assert not drain.is_due(0.01)
        if event == "report":
            drain.on_report()
        bad_frames += event == "damage"
        drain.on_clock_reply(99, bad_frames)
        assert not drain.is_due(0.01)
        drain.on_clock_reply(stamp, bad_frames)
    assert drain.is_complete
    drain.begin_exchange(7, 1.0, bad_frames)
    assert drain.is_due(1.1)  # a request, or its answer, was lost


def test_a_flush_of_the_planner_in_a_pause_loses_nothing_of_it(rig):
    rig.begin(build_points(500, DUTY))
    rig.run(0.2)
    rig.request(WEB, "pause")
    rig.send(PLANNER, "flush")
    rig.until(lambda: read_drained(rig) == [1])
    assert rig.session.board.state == BoardState.ARMED
    command(rig, "resume")
    rig.until(lambda: rig.session.is_ready)


def test_a_pause_ends_with_the_epoch_and_its_waiters_are_answered(rig):
    rig.begin(build_points(500, DUTY))
    rig.run(0.2)
    waiting = rig.request(WEB, "pause")
    rig.request(OPERATOR, "stop")
    result = rig.await_result(WEB, waiting)
    assert (result["error"]["code"], result["pause"]["ends_in_s"]) == ("not_ready", None)
    assert "ended by stop" in result["error"]["message"]
    rig.until(lambda: rig.session.board.state == BoardState.DISARMED)
    rig.arm()
    emitted = len(rig.list_emitted())
    rig.begin(build_points(10, DUTY))
    rig.until(lambda: len(rig.list_emitted()) == emitted + 10)


def test_a_pause_of_five_minutes_ends_disarmed(rig):
    before = rig.epoch
    command(rig, "pause")
    rig.run(PAUSE_MAX_S - 1.0, 10 * STEP_S)
    assert (rig.session.board.state, rig.epoch) == (BoardState.ARMED, before)
    rig.run(1.1, 10 * STEP_S)
    assert (rig.session.board.state, rig.epoch) == (BoardState.DISARMED, before + 1)
    assert rig.service.epoch.reason == "the light was paused for 300 s"
