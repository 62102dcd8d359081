"""The link service in virtual time: epochs, both gates, the lease's conditions, results and reports."""

import numpy as np
import pytest

from link_service_rig import OPERATOR, PLANNER, SUPERVISOR, WEB, ServiceRig
from optodrive.core.ipc import IpcError, Message
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, FrameDecoder, encode_frame
from optodrive.link.protocol.states import BoardState
from optodrive.link.service import control
from optodrive.link.service.control import HOLD_MAX_S
from optodrive.link.service.link_connection import build_error
from optodrive.link.service.link_service import LinkService
from optodrive.link.service.point_handover import EXECUTED
from optodrive.link.service.remote_session import EXECUTED_RECORD
from optodrive.link.session.session import BoardSession
from wire_points import build_points

DUTY = 1000


@pytest.fixture
def rig():
    return ServiceRig().hello_all().connect()


def test_a_plan_is_executed_and_reported_to_the_planner(rig):
    rig.arm()
    number = rig.begin(build_points(100, DUTY))
    rig.until(lambda: any(m.fields["finished"] for m in rig.of_kind(PLANNER, "progress")))
    assert len(rig.list_emitted()) == 100
    last = rig.of_kind(PLANNER, "progress")[-1].fields
    assert (last["job"], last["sent_points"], last["finished"]) == (number, [100], True)
    positions = []
    for message in rig.of_kind(PLANNER, "executed"):
        records = np.frombuffer(message.payload, EXECUTED_RECORD)
        positions += range(message.fields["first_point"], message.fields["first_point"] + len(records))
        assert set(records["duty"]) == {DUTY}
        assert set(records["on_ticks"]) == {200}
    assert sorted(set(positions)) == list(range(100))
    rig.run(0.1)
    assert rig.of_kind(PLANNER, "status")[-1].fields["is_startable"]


def test_the_record_of_both_ends_is_the_same():
    record = 1 << 40, 65_535, 7
    assert np.frombuffer(EXECUTED.pack(*record), EXECUTED_RECORD).tolist() == [record]


@pytest.mark.parametrize("client", [WEB, OPERATOR, SUPERVISOR, PLANNER])
def test_stop_of_any_client_ends_the_epoch_and_the_plan(rig, client):
    rig.arm()
    rig.begin(build_points(500, DUTY))
    rig.run(0.3)
    before, emitted = rig.epoch, len(rig.list_emitted())
    assert emitted
    result = rig.await_result(client, rig.request(client, "stop"))
    assert result["error"] is None
    assert result["board"]["state"] == BoardState.DISARMED
    assert result["epoch"] == rig.epoch == before + 1
    rig.run(1.0)
    assert len(rig.list_emitted()) <= emitted + 2
    rig.arm().run(1.5)
    assert len(rig.list_emitted()) <= emitted + 2
    status = rig.of_kind(PLANNER, "status")[-1].fields
    assert (status["epoch"], status["epoch_reason"]) == (before + 1, "ended by stop")


def test_points_of_an_older_epoch_are_refused_after_arming(rig):
    older = rig.epoch
    rig.await_result(WEB, rig.request(WEB, "disarm"))
    rig.arm()
    rig.begin(build_points(10, DUTY), epoch=older)
    rig.run(0.5)
    assert rig.list_emitted() == []
    assert "ended by disarm" in rig.find_refusals()[0]
    rig.begin(build_points(10, DUTY))
    rig.until(lambda: len(rig.list_emitted()) == 10)


def test_a_splice_of_an_older_epoch_changes_nothing(rig):
    older = rig.epoch
    rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))
    rig.arm()
    rig.begin(build_points(200, DUTY), ahead_s=0.04)
    rig.run(0.15)
    _, result = rig.splice(build_points(10, 2 * DUTY), 150, epoch=older, ahead_s=0.04)
    assert result["start_tick"] is None
    assert "ended by stop" in result["error"]["message"]
    rig.until(lambda: len(rig.list_emitted()) == 200)
    assert {duty for _, duty in rig.list_emitted()} == {DUTY}


def test_a_splice_continues_the_plan_without_a_pause(rig):
    rig.arm()
    rig.begin(build_points(200, DUTY), ahead_s=0.04)
    rig.run(0.15)
    number, result = rig.splice(build_points(10, 2 * DUTY), 150, ahead_s=0.04)
    assert result["error"] is None
    assert result["first_index"] == [150]
    rig.until(lambda: any(m.fields["finished"] and m.fields["job"] == number for m in rig.of_kind(PLANNER, "progress")))
    emitted = rig.list_emitted()
    assert [duty for _, duty in emitted] == [DUTY] * 150 + [2 * DUTY] * 10
    assert np.diff([at_s for at_s, _ in emitted]) == pytest.approx(0.0022)


def test_points_appended_to_a_job_continue_it_without_a_pause(rig):
    rig.arm()
    number = rig.begin(build_points(100, DUTY), ahead_s=0.04)
    rig.run(0.15)
    assert rig.extend(number, build_points(60, 2 * DUTY))["done"]
    assert rig.extend(number, build_points(10, 3 * DUTY))["done"]
    rig.until(lambda: any(m.fields["finished"] and m.fields["job"] == number for m in rig.of_kind(PLANNER, "progress")))
    emitted = rig.list_emitted()
    assert [duty for _, duty in emitted] == [DUTY] * 100 + [2 * DUTY] * 60 + [3 * DUTY] * 10
    assert np.diff([at_s for at_s, _ in emitted]) == pytest.approx(0.0022)
    reports = b"".join(message.payload for message in rig.of_kind(PLANNER, "executed"))
    assert len(reports) == 170 * EXECUTED.size
    assert rig.session.board.underruns == 0


def test_points_are_appended_only_to_the_last_job_while_it_runs(rig):
    rig.arm()
    first = rig.begin(build_points(200, DUTY), ahead_s=0.04)
    rig.run(0.15)
    assert not rig.extend(first + 1, build_points(10, 2 * DUTY))["done"]
    second, _ = rig.splice(build_points(50, DUTY), 150, ahead_s=0.04)
    assert not rig.extend(first, build_points(10, 2 * DUTY))["done"]
    assert rig.find_result(PLANNER, rig.request(PLANNER, "truncate", kept_points=[40]))["done"]
    assert not rig.extend(second, build_points(10, 2 * DUTY))["done"]
    rig.until(lambda: len(rig.list_emitted()) == 190 and rig.session.is_ready)
    third = rig.begin(build_points(20, DUTY), ahead_s=0.04)
    rig.until(lambda: len(rig.list_emitted()) == 200)  # the last points have left, and END with them
    assert rig.extend(third, build_points(10, DUTY))["done"]
    rig.until(lambda: len(rig.list_emitted()) == 219)
    assert not rig.extend(third, build_points(10, 2 * DUTY))["done"]
    rig.run(0.5)
    assert [duty for _, duty in rig.list_emitted()] == [DUTY] * 220
    assert rig.session.board.underruns == 0


def test_appended_points_pass_the_gates_of_a_splice(rig):
    older = rig.epoch
    rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))
    rig.arm()
    number = rig.begin(build_points(100, DUTY), ahead_s=0.04)
    rig.run(0.1)
    points = build_points(10, 2 * DUTY)
    assert "ended by stop" in rig.extend(number, points, epoch=older)["error"]["message"]
    assert "CRC-32" in rig.extend(number, points, crc=0)["error"]["message"]
    rig.request(WEB, "pause")
    assert "paused" in rig.extend(number, points)["error"]["message"]
    rig.run(0.5)
    assert {duty for _, duty in rig.list_emitted()} == {DUTY}


def test_truncation_ends_the_plan_early(rig):
    rig.arm()
    rig.begin(build_points(200, DUTY), ahead_s=0.04)
    rig.run(0.15)
    assert rig.find_result(PLANNER, rig.request(PLANNER, "truncate", kept_points=[100]))["done"]
    assert not rig.find_result(PLANNER, rig.request(PLANNER, "truncate", kept_points=[1]))["done"]
    rig.run(1.0)
    assert len(rig.list_emitted()) == 100


def test_flush_ends_the_plan_and_stays_armed_in_the_same_epoch(rig):
    rig.arm()
    rig.begin(build_points(500, DUTY))
    rig.run(0.3)
    before = rig.epoch
    rig.send(PLANNER, "flush")
    rig.until(lambda: rig.session.is_ready)
    assert rig.epoch == before
    emitted = len(rig.list_emitted())
    assert emitted < 200, "of 500: the rest was dropped"
    rig.begin(build_points(5, 2 * DUTY))
    rig.until(lambda: len(rig.list_emitted()) == emitted + 5)


def test_damaged_points_are_refused(rig):
    rig.arm()
    rig.begin(build_points(10, DUTY), crc=1)
    rig.run(0.5)
    assert "CRC" in rig.find_refusals()[0]
    assert rig.list_emitted() == []


def test_points_before_arming_and_during_a_job_are_refused(rig):
    rig.begin(build_points(10, DUTY))
    assert "arm it first" in rig.find_refusals()[0]
    rig.arm()
    rig.begin(build_points(10, DUTY))
    rig.begin(build_points(10, 2 * DUTY))
    assert "earlier job" in rig.find_refusals()[1]
    rig.run(1.0)
    assert {duty for _, duty in rig.list_emitted()} == {DUTY}


@pytest.mark.parametrize("client", [PLANNER, WEB])
def test_the_loss_of_planner_or_web_turns_the_gate_off_at_once(rig, client):
    rig.arm()
    rig.begin(build_points(500, DUTY))
    rig.run(0.3)
    before = rig.epoch
    rig.leave(client)
    rig.run(0.01)
    assert rig.core.state == BoardState.DISARMED
    assert rig.epoch == before + 1


def test_a_plan_may_finish_without_web_if_so_configured():
    rig = ServiceRig(on_web_loss="finish").hello_all().connect().arm()
    rig.begin(build_points(500, DUTY))
    rig.run(0.3)
    before = rig.epoch
    rig.leave(WEB)
    rig.until(lambda: len(rig.list_emitted()) == 500)
    rig.run(4.0)
    assert rig.epoch == before
    assert rig.core.state == BoardState.ARMED
    rig.run(1.5)  # nobody could disarm
    assert rig.epoch == before + 1
    assert rig.core.state == BoardState.DISARMED


def test_a_web_process_that_comes_back_keeps_the_board_armed():
    rig = ServiceRig(on_web_loss="finish").hello_all().connect().arm()
    rig.leave(WEB)
    rig.run(3.0)
    rig.hello(WEB, "web")
    rig.run(8.0)
    assert rig.core.state == BoardState.ARMED


def test_a_board_that_disarms_by_itself_ends_the_epoch_once(rig):
    rig.arm()
    before = rig.epoch
    rig.core.on_link_lost(round(rig.clock.now_s() * 1e6))
    rig.run(0.5)
    assert rig.epoch == before + 1
    assert rig.of_kind(WEB, "status")[-1].fields["epoch_reason"] == "the board went to DISARMED (link lost)"


@pytest.mark.parametrize(("client", "says"), [(PLANNER, "planner made no progress"), (WEB, "web process did not")])
def test_without_beats_the_lease_expires_and_the_cause_is_named(rig, client, says):
    rig.arm()
    rig.begin(build_points(1500, DUTY))
    rig.run(0.3)
    rig.alive[client] = None
    rig.until(lambda: rig.core.fault == "LINK", patience_s=2.0)
    rig.run(0.1)
    status = rig.of_kind(SUPERVISOR, "status")[-1].fields
    assert says in status["likely_cause"][0]
    assert says in status["epoch_reason"]
    assert len(rig.list_emitted()) < 1500


def test_a_planner_without_progress_withholds_the_lease(rig):
    rig.arm()
    rig.alive[PLANNER] = False
    rig.until(lambda: rig.core.fault == "LINK", patience_s=1.0)


def test_arming_needs_planner_and_web(rig):
    rig.leave(PLANNER)
    rig.run(0.1)
    result = rig.await_result(WEB, rig.request(WEB, "arm"))
    assert "planner process" in result["error"]["message"]
    rig.hello(PLANNER, "planner")
    rig.run(0.1)
    rig.arm()


def test_the_status_names_who_withholds_the_lease(rig):
    rig.run(0.02)
    assert rig.of_kind(SUPERVISOR, "status")[-1].fields["stalled"] == ""
    rig.leave(WEB)
    rig.run(0.01)
    assert rig.of_kind(SUPERVISOR, "status")[-1].fields["stalled"] == "web"


@pytest.mark.parametrize("kind", ["arm", "stop"])
def test_all_know_the_new_state_before_a_caller_has_the_answer(rig, kind):
    """A caller who knows of ARMED may push at once, and the planner must not refuse it."""
    if kind == "stop":
        rig.arm()
    request, seen = rig.request(WEB, kind), []
    collect = rig.service.pop_outgoing

    def keep():
        seen.extend(collected := collect())
        return collected

    rig.service.pop_outgoing = keep
    rig.await_result(WEB, request)
    (answered,) = (k for k, (_, message) in enumerate(seen) if message.kind == "result")
    state = seen[answered].message.fields["board"]["state"]
    known = [message.fields for clients, message in seen[:answered] if PLANNER in clients and message.kind == "status"]
    assert state == (BoardState.ARMED if kind == "arm" else BoardState.DISARMED)
    assert (known[-1]["board"]["state"], known[-1]["epoch"]) == (state, rig.epoch)


def test_a_fault_and_its_acknowledgement_end_epochs(rig):
    rig.arm()
    before = rig.epoch
    rig.core.set_input("interlock", False, round(rig.clock.now_s() * 1e6))
    rig.run(0.1)
    assert rig.epoch == before + 1
    rig.core.set_input("interlock", True, round(rig.clock.now_s() * 1e6))
    rig.await_result(WEB, rig.request(WEB, "disarm"))
    assert rig.epoch == before + 2


def test_stop_while_arming_ends_the_callers_wait(rig):
    armed = rig.request(WEB, "arm")
    rig.run(0.5)
    rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))
    error = build_error(rig.find_result(WEB, armed)["error"])
    assert "ended by stop" in str(error)
    assert type(error).__name__ == "NotReadyError"
    rig.run(3.0)
    assert rig.core.state == BoardState.DISARMED


def test_the_link_is_retried_and_its_loss_ends_the_epoch(rig):
    rig.arm()
    before = rig.epoch
    silent = rig.link.read
    rig.link.read = lambda timeout_s: silent(timeout_s) and b""
    rig.until(lambda: not rig.session.connected)
    assert rig.epoch > before
    rig.run(0.1)
    status = rig.of_kind(WEB, "status")[-1].fields
    assert not status["connected"]
    assert status["link_error_code"] == "link"
    result = rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))
    assert result["error"]["code"] == "link"
    rig.link.read = silent
    rig.until(lambda: rig.session.connected)
    rig.run(0.1)
    assert rig.of_kind(WEB, "status")[-1].fields["link_error"] is None


def test_a_board_that_contradicts_the_configuration_is_said_and_retried():
    rig = ServiceRig().hello_all()
    accepts = rig.session._requirements
    object.__setattr__(rig.session, "_requirements", type(accepts)(**{**vars(accepts), "uid": "00"}))
    rig.run(0.3)
    status = rig.of_kind(WEB, "status")[-1].fields
    assert status["link_error_code"] == "board"
    assert "expected the board of this uid; the connected one has" in status["link_error"]
    rig.session._requirements = accepts
    rig.until(lambda: rig.session.connected)


@pytest.mark.parametrize(
    ("client", "kind"),
    [(OPERATOR, "arm"), (OPERATOR, "begin"), (WEB, "begin"), (PLANNER, "arm"), (SUPERVISOR, "arm"), (9, "stop")],
)
def test_roles_bound_what_a_client_may_send(rig, client, kind):
    with pytest.raises(IpcError, match="not permitted"):
        rig.request(client, kind)


def test_only_the_own_user_is_more_than_an_operator(rig):
    rig.hello(10, "operator", trusted=False)
    with pytest.raises(IpcError, match="role"):
        rig.hello(11, "planner", trusted=False)
    rig.await_result(10, rig.request(10, "stop"))


def test_a_second_planner_replaces_the_first_in_the_dark(rig):
    rig.arm()
    rig.begin(build_points(500, DUTY))
    rig.run(0.3)
    del rig.alive[PLANNER]
    rig.hello(12, "planner")
    rig.run(0.01)
    assert rig.core.state == BoardState.DISARMED
    with pytest.raises(IpcError, match="not permitted"):
        rig.begin(build_points(5, DUTY))


@pytest.mark.parametrize(
    "message",
    [
        Message("begin", {}),
        Message("begin", {"job": 1, "epoch": "x", "start_s": 0, "ahead_s": None, "crc": 0}),
        Message("begin", {"job": 1, "epoch": 1, "start_s": 0, "ahead_s": None, "crc": 0}, b"123"),
        Message("splice", {"id": 1}),
        Message("extend", {"id": 1}),
        Message("truncate", {"id": None}),
        Message("delay", {"job": [], "ticks": 0}),
        Message("beat", {}),
        Message("stop", {"id": "x"}),
        Message("hello", {}),
    ],
)
def test_a_malformed_message_ends_only_its_client(rig, message):
    with pytest.raises(IpcError):
        rig.service.on_message(PLANNER, message)
    rig.run(0.1)


def find_control(rig):
    return rig.of_kind(WEB, "status")[-1].fields["control"]


def test_the_status_states_who_armed_the_board_and_when(rig):
    rig.run(0.2)
    assert find_control(rig) is None
    rig.arm(caller="ann")
    rig.run(1.0)
    control = find_control(rig)
    assert control["caller"] == "ann"
    assert control["armed_for_s"] == pytest.approx(3.0, abs=0.5)
    rig.await_result(WEB, rig.request(WEB, "disarm"))
    rig.run(0.2)
    assert find_control(rig) is None


def test_revoking_the_token_that_armed_the_board_ends_dark(rig):
    rig.arm(caller="ann")
    rig.begin(build_points(500, DUTY))
    rig.run(0.3)
    before = rig.epoch
    rig.send(WEB, "revoke", caller="ben")
    rig.run(0.1)
    assert (rig.epoch, rig.session.board.state) == (before, BoardState.RUNNING)
    rig.send(WEB, "revoke", caller="ann")
    emitted = len(rig.list_emitted())
    assert emitted
    rig.until(lambda: rig.session.board.state == BoardState.DISARMED)
    assert len(rig.list_emitted()) <= emitted + 2
    rig.run(0.2)
    status = rig.of_kind(PLANNER, "status")[-1].fields
    assert status["epoch_reason"] == "the token 'ann', which armed the board, was revoked"


def test_revoking_the_token_that_is_arming_the_board_ends_the_arming(rig):
    request_id = rig.request(WEB, "arm", caller="ann")
    rig.run(0.5)
    rig.send(WEB, "revoke", caller="ann")
    assert "was revoked" in rig.await_result(WEB, request_id)["error"]["message"]
    rig.run(3.0)
    assert rig.session.board.state == BoardState.DISARMED


@pytest.mark.parametrize("client", [PLANNER, OPERATOR, SUPERVISOR])
def test_only_the_web_process_may_revoke(rig, client):
    with pytest.raises(IpcError, match="not permitted"):
        rig.send(client, "revoke", caller="ann")


ARMING = 77


def hold(rig, duration_s, beat_s=0.25, age_s=0.0):
    """Run while a client holds the arming with beats that arrive age_s late."""
    until_s = rig.clock.now_s() + duration_s
    while rig.clock.now_s() < until_s:
        rig.send(WEB, "hold", arming=ARMING, age_s=age_s)
        rig.run(beat_s)


def arm_and_hold(rig):
    """Arm the board with beats, and begin a plan."""
    request_id = rig.request(WEB, "arm", caller="ann", arming=ARMING, hold=True)
    hold(rig, 3.0)
    assert rig.find_result(WEB, request_id)["error"] is None
    rig.begin(build_points(3000, DUTY))
    hold(rig, 2.0)
    assert rig.session.board.state == BoardState.RUNNING
    assert find_control(rig)["hold"]
    return rig.clock.now_s()


def find_dark_s(rig, began_s, patience_s=3.0):
    """Return the time until the board was disarmed, None if it still emits."""
    while rig.clock.now_s() < began_s + patience_s:
        rig.run(0.01)
        if rig.session.board.state == BoardState.DISARMED:
            emitted = len(rig.list_emitted())
            dark_s = rig.clock.now_s() - began_s
            rig.run(0.5)
            assert len(rig.list_emitted()) == emitted
            return dark_s
    return None


@pytest.mark.parametrize("on_web_loss", ["dark", "finish"])
def test_a_held_arming_ends_without_beats(on_web_loss):
    rig = ServiceRig(on_web_loss).hello_all().connect()
    dark_s = find_dark_s(rig, arm_and_hold(rig))
    assert HOLD_MAX_S - 0.3 < dark_s < HOLD_MAX_S + 0.1
    assert rig.service.epoch.reason == "the client of 'ann' that held the board armed does not beat"


def test_without_the_limit_it_would_not(rig, monkeypatch):
    """Mutant."""
    monkeypatch.setattr(control, "HOLD_MAX_S", float("inf"))
    assert find_dark_s(rig, arm_and_hold(rig)) is None


def test_a_held_arming_ends_with_its_client_at_once(rig):
    began_s = arm_and_hold(rig)
    rig.send(WEB, "release", arming=ARMING + 1, reason="another client has left")
    hold(rig, 0.5)
    assert rig.session.board.state == BoardState.RUNNING
    began_s = rig.clock.now_s()
    rig.send(WEB, "release", arming=ARMING, reason="the client has left")
    assert find_dark_s(rig, began_s) < 0.05
    assert rig.service.epoch.reason == "the client has left"


def test_beats_that_waited_or_that_belong_to_another_arming_hold_nothing(rig):
    began_s = arm_and_hold(rig)
    while rig.session.board.state == BoardState.RUNNING and rig.clock.now_s() < began_s + 3.0:
        rig.send(WEB, "hold", arming=ARMING + 1, age_s=0.0)
        rig.send(WEB, "hold", arming=ARMING, age_s=rig.clock.now_s() - began_s + 0.25)
        rig.run(0.05)
    assert rig.clock.now_s() - began_s < HOLD_MAX_S + 0.1


def test_a_held_arming_ends_with_the_web_process_even_if_others_may_finish():
    rig = ServiceRig("finish").hello_all().connect()
    began_s = arm_and_hold(rig)
    rig.leave(WEB)
    assert find_dark_s(rig, began_s) < HOLD_MAX_S + 0.1


def test_a_client_that_leaves_while_the_board_arms_ends_the_arming(rig):
    request_id = rig.request(WEB, "arm", caller="ann", arming=ARMING, hold=True)
    hold(rig, 0.5)
    rig.send(WEB, "release", arming=ARMING, reason="the client has left")
    assert "the client has left" in rig.await_result(WEB, request_id)["error"]["message"]
    rig.run(3.0)
    assert rig.session.board.state == BoardState.DISARMED


# --- one arming at a time -------------------------------------------------------------------------------------------


def arm_twice(rig, delay_s):
    """Request two armings, the second after a delay. Return both results."""
    first = rig.request(WEB, "arm", caller="ann")
    rig.run(delay_s)
    second = rig.request(WEB, "arm", caller="ben")
    return rig.await_result(WEB, first)["error"], rig.await_result(WEB, second)["error"]


@pytest.mark.parametrize(
    ("delay_s", "says"),
    [(0.0, "'ann' is arming"), (0.001, "'ann' is arming"), (0.5, "'ann' is arming"), (2.5, "'ann' has armed")],
)
def test_a_second_arming_is_refused_with_the_caller_of_the_first_and_does_not_touch_it(rig, delay_s, says):
    before = rig.epoch
    first, second = arm_twice(rig, delay_s)
    assert first is None
    assert f"{says} the board" in second["message"]
    rig.run(0.5)
    assert (rig.core.state, rig.epoch, find_control(rig)["caller"]) == (BoardState.ARMED, before, "ann")


def test_without_that_rule_neither_would_arm(rig, monkeypatch):
    """Mutant: both reach the board, whose challenge answers the first and is expected for the second."""
    monkeypatch.setattr(LinkService, "_require_no_control", lambda _: None)
    monkeypatch.setattr(BoardSession, "has_arming", property(lambda session: session._arming.is_present and False))
    first, second = arm_twice(rig, 0.0)
    assert first
    assert second


def test_an_arming_that_takes_too_long_ends_dark(rig):
    """A caller who is told that the board did not arm never finds it armed."""
    lost, rig.link.read = rig.link.read, lambda timeout_s: drop_frames(lost(timeout_s), m.ArmChallenge)
    result = rig.await_result(WEB, rig.request(WEB, "arm", caller="ann"))
    assert "did not arm within" in result["error"]["message"]
    rig.run(0.1)
    assert rig.core.state == BoardState.DISARMED
    assert find_control(rig) is None
    rig.link.read = lost
    rig.await_result(WEB, rig.request(WEB, "disarm"))
    rig.arm()


def test_a_board_that_acknowledges_nothing_is_a_lost_link(rig):
    rig.arm()
    rig.begin(build_points(1500, DUTY))
    lost = rig.link.read
    rig.link.read = lambda timeout_s: drop_frames(lost(timeout_s), m.Ack, m.Nak)
    rig.until(lambda: not rig.boards.connected)
    rig.run(0.2)
    assert "acknowledges nothing" in rig.of_kind(WEB, "status")[-1].fields["link_error"]
    assert rig.core.state == BoardState.DISARMED
    rig.link.read = lost
    rig.until(lambda: rig.boards.connected)
    rig.arm()


def test_a_report_that_cannot_be_is_the_cause_of_the_loss_and_sends_abort(rig):
    rig.arm()
    rig.begin(build_points(1500, DUTY))
    rig.run(0.3)
    honest = rig.link.read
    board = rig.core._link

    def read_with_a_false_report(timeout_s):
        data, report = honest(timeout_s), m.Ack(board.expected_seq, 65_535, 0, m.STATES.index("RUNNING"))
        return data + encode_frame(Frame(m.Ack.TYPE, 0, board.session, report.encode_body()))

    rig.link.read = read_with_a_false_report
    rig.run(0.004)
    rig.link.read = honest
    assert rig.core.state == BoardState.DISARMED
    assert [entry["reason"] for entry in rig.log if entry["event"] == "state"][-1] == "abort"
    rig.run(0.05)
    status = rig.of_kind(WEB, "status")[-1].fields
    says = "the board reports free_points 65535 in ACK, expected at most 4096, the queue's room"
    assert status["likely_cause"][0] == status["link_error"] == says
    rig.until(lambda: rig.boards.connected)
    rig.arm()


def test_stop_is_confirmed_by_a_status_while_no_acknowledgement_arrives(rig):
    rig.arm()
    rig.begin(build_points(500, DUTY))
    rig.run(0.3)
    lost = rig.link.read
    rig.link.read = lambda timeout_s: drop_frames(lost(timeout_s), m.Ack, m.Event)
    began_s = rig.clock.now_s()
    assert rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))["error"] is None
    assert rig.clock.now_s() - began_s < 0.5


def test_an_arming_ends_with_its_caller_even_if_plans_may_finish():
    rig = ServiceRig("finish").hello_all().connect()
    rig.request(WEB, "arm", caller="ann")
    rig.run(0.5)
    rig.leave(WEB)
    rig.run(0.01)
    assert rig.core.state == BoardState.DISARMED


def drop_frames(data, *kinds):
    """Return the frames in bytes from the board, without those of some messages."""
    kept = (frame for frame in FrameDecoder().feed(data) if frame.type not in [kind.TYPE for kind in kinds])
    return b"".join(encode_frame(frame) for frame in kept)
