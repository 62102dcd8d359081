"""Pause and resume over a real link service in virtual time, judged from the board's log."""

from dataclasses import replace

import numpy as np
import pytest

from link_service_rig import OPERATOR, WEB, ServiceRig
from optodrive.core.errors import NotReadyError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.link.protocol.states import BoardState
from optodrive.link.service.control import PAUSE_MAX_S
from planner_rig import build_frame, build_train

KEPT_INTERRUPT = ActivePlan.interrupt
DARK_WITHIN_S = 0.004
"""Time from a request to the end of the light: one exchange with the board."""


def submit(rig, sequence, streamed=False, caller=""):
    return rig.store.find(rig.submit(sequence, rig.remote.epoch, streamed, caller).result().plan)


def finish(rig, record):
    rig.until(lambda: record.has_ended)
    return record


def command(rig, kind):
    result = rig.await_result(WEB, rig.request(WEB, kind))
    assert result["error"] is None, result
    rig.run(0.05)


def list_pulses(rig):
    """Return (gate on in s, gate-on time in µs, duty) of all pulses that the board has emitted."""
    pulses = [event for event in rig.log if event["event"] == "pulse"]
    return [(event["on_us"] * 1e-6, event["off_us"] - event["on_us"], event["duty"]) for event in pulses]


def test_a_pause_is_dark_at_once_and_resume_plays_exactly_the_rest(rig):
    record = submit(rig, build_train(2.0))
    rig.until(lambda: record.executed_count > 20)
    requested_s = rig.session.board_s()
    command(rig, "pause")
    before = list_pulses(rig)
    assert (record.status, rig.session.board.state) == ("paused", BoardState.ARMED)
    assert record.executed_count == record.sent == len(before)
    rig.run(3.0)
    assert list_pulses(rig) == before
    on_s, on_us, _ = before[-1]
    assert on_s + on_us * 1e-6 < requested_s + DARK_WITHIN_S

    resumed_s = rig.session.board_s()
    command(rig, "resume")
    assert record.status == "running"
    finish(rig, record)
    assert record.status == "done"
    pulses = list_pulses(rig)
    assert len(pulses) == record.executed_count == record.pulse_count
    assert pulses[len(before)][0] > resumed_s
    assert record.execution.complete
    assert record.execution.start_s + record.start_s == pytest.approx([on_s for on_s, _, _ in pulses], abs=2e-6)
    assert np.diff([on_s for on_s, _, _ in pulses[len(before) :]]) == pytest.approx(0.02, abs=2e-6)


def test_without_its_mark_the_part_before_would_be_lit_twice(rig, monkeypatch):
    """Mutant: the first row that is left is not kept."""

    def interrupt(plan, off_s):
        return replace(KEPT_INTERRUPT(plan, off_s), first_row=0)

    monkeypatch.setattr(ActivePlan, "interrupt", interrupt)
    record = submit(rig, build_train(0.5))
    rig.until(lambda: record.executed_count > 5)
    command(rig, "pause")
    command(rig, "resume")
    finish(rig, record)
    assert len(rig.list_emitted()) > record.pulse_count


def test_a_pulse_that_the_pause_cuts_counts_as_executed(rig):
    record = submit(rig, FrameSequence((), (PulseTrain(3, 0.0, 2.0, 0.04, 0.02, 1.0),)))
    rig.until(lambda: rig.core.machine.gate and record.executed_count > 3)
    command(rig, "pause")
    *whole, cut = list_pulses(rig)
    assert 0 < cut[1] < whole[0][1]
    assert record.executed_count == len(whole) + 1
    command(rig, "resume")
    finish(rig, record)
    assert [on_us == whole[0][1] for _, on_us, _ in list_pulses(rig)].count(False) == 1
    assert len(list_pulses(rig)) == record.pulse_count
    assert record.execution.width_s.min() == pytest.approx(cut[1] * 1e-6)


def test_several_pauses_play_each_pulse_once_and_keep_the_gaps(rig):
    frames = tuple(TactileFrame(str(k), 1.0 * k, 0.9, np.full(16, 50e-6)) for k in range(4))
    record = submit(rig, FrameSequence(frames))
    began_s, paused_s = rig.session.board_s(), 0.0
    for wait_s in (0.02, 0.5, 0.52, 0.7, 1.3):
        rig.run(wait_s)
        requested_s = rig.session.board_s()
        command(rig, "pause")
        rig.run(1.5)
        command(rig, "resume")
        paused_s += rig.session.board_s() - requested_s
    finish(rig, record)
    assert (record.status, record.executed_count) == ("done", record.pulse_count)
    assert len(rig.list_emitted()) == record.pulse_count == 64
    played_s = rig.list_emitted()[-1][0] - began_s - paused_s
    assert 3.0 < played_s < 3.7
    planned = np.array(sorted(duty for duty in record.pulses.power_w))
    assert planned.min() > 0.0


def test_plans_that_wait_and_plans_of_the_pause_follow_in_order(rig):
    running, waiting = submit(rig, build_train(1.0, pixel=1)), submit(rig, build_train(0.5, pixel=2))
    rig.until(lambda: running.executed_count > 5)
    command(rig, "pause")
    later = submit(rig, build_train(0.5, pixel=4))
    assert [record.status for record in (running, waiting, later)] == ["paused", "queued", "queued"]
    rig.run(20.0)
    command(rig, "resume")
    finish(rig, later)
    records = running, waiting, later
    assert [record.status for record in records] == ["done"] * 3
    assert all(record.executed_count == record.pulse_count for record in records)
    positions = [event["x"] for event in rig.log if event["event"] == "pulse"]
    assert positions == sorted(positions, key=positions.index)  # one pixel after the other
    assert len(positions) == sum(record.pulse_count for record in records)


def test_a_pause_without_plans_keeps_what_is_submitted_meanwhile(rig):
    command(rig, "pause")
    record = submit(rig, build_train(0.3))
    rig.run(1.0)
    assert rig.list_emitted() == []
    command(rig, "resume")
    finish(rig, record)
    assert record.executed_count == record.pulse_count == len(rig.list_emitted())


def test_both_commands_may_be_repeated(rig):
    record = submit(rig, build_train(1.0))
    rig.until(lambda: record.executed_count > 5)
    for _ in range(3):
        command(rig, "pause")
    before = len(rig.list_emitted())
    rig.run(0.5)
    assert len(rig.list_emitted()) == before
    for _ in range(3):
        command(rig, "resume")
    finish(rig, record)
    assert len(rig.list_emitted()) == record.pulse_count


def test_a_quick_pause_and_resume_loses_and_doubles_nothing(rig):
    record = submit(rig, build_train(2.0))
    for _ in range(20):
        rig.run(0.06)
        rig.request(WEB, "pause")
        rig.run(0.0)
        rig.request(WEB, "resume")
    finish(rig, record)
    assert record.executed_count == record.pulse_count == len(rig.list_emitted())


def test_a_stream_is_dropped_by_a_pause_and_refused_while_it_lasts(rig):
    streamed = submit(rig, build_frame(60.0, duration_s=9.0), streamed=True)
    waiting = submit(rig, build_train(0.2))
    rig.until(lambda: streamed.executed_count > 2)
    command(rig, "pause")
    assert streamed.status == "superseded"
    assert "the light was paused" in streamed.error
    assert streamed.executed_count + streamed.dropped == streamed.pulse_count
    with pytest.raises(NotReadyError, match="the light is paused, and a streamed frame shows the present; resume"):
        submit(rig, build_frame(), streamed=True)
    assert waiting.status == "queued"
    command(rig, "resume")
    finish(rig, waiting)
    newest = finish(rig, submit(rig, build_frame(), streamed=True))
    assert (waiting.status, newest.status) == ("done", "done")


def test_a_frame_that_is_being_planned_when_the_light_is_paused_is_refused(rig):
    def pause():
        rig.before_loop_action = lambda: None
        command(rig, "pause")

    rig.before_loop_action = pause
    with pytest.raises(NotReadyError, match="paused"):
        submit(rig, build_frame(), streamed=True)
    assert not rig.queue.is_busy


def test_a_stream_after_the_resumption_replaces_the_rest(rig):
    record = submit(rig, build_train(2.0))
    rig.until(lambda: record.executed_count > 5)
    command(rig, "pause")
    rig.await_result(WEB, rig.request(WEB, "resume"))
    ServiceRig.run(rig)  # the link process sends its status together with the result
    newest = submit(rig, build_frame(), streamed=True)
    finish(rig, newest)
    assert (record.status, newest.status) == ("superseded", "done")
    assert record.executed_count + record.dropped == record.pulse_count
    assert len(rig.list_emitted()) == record.executed_count + newest.executed_count


def test_a_resumed_plan_that_a_stream_replaces_drops_only_what_was_not_executed(rig):
    """Its pulses from before the pause count, in its report and in the budget."""
    record = submit(rig, build_train(3.0))
    rig.until(lambda: record.executed_count > 40)
    command(rig, "pause")
    command(rig, "resume")
    rig.until(lambda: record.status == "running" and record.executed_count > 60)
    newest = finish(rig, submit(rig, build_frame(), streamed=True))
    assert (record.status, newest.status) == ("superseded", "done")
    assert record.executed_count <= record.pulse_count - record.dropped <= record.sent


def test_a_paused_plan_can_be_cancelled_and_the_next_goes_on(rig):
    record, following = submit(rig, build_train(9.0)), submit(rig, build_train(0.3, pixel=5))
    rig.until(lambda: record.executed_count > 5)
    command(rig, "pause")
    before = len(rig.list_emitted())
    rig.queue.cancel(record)
    assert (record.status, record.executed_count, len(record.execution.start_s)) == ("cancelled", before, before)
    command(rig, "resume")
    began_s = rig.session.board_s()
    finish(rig, following)
    assert rig.session.board_s() - began_s < 1.0
    assert len(rig.list_emitted()) == before + following.pulse_count

    record = submit(rig, build_train(9.0))
    rig.until(lambda: record.executed_count > 5)
    command(rig, "pause")
    rig.queue.cancel(record)
    command(rig, "resume")
    began_s = rig.session.board_s()
    finish(rig, submit(rig, build_train(0.1)))
    assert rig.session.board_s() - began_s < 1.0


def test_dimming_during_a_pause_dims_what_is_left(rig):
    record = submit(rig, build_train(0.5))
    rig.until(lambda: record.executed_count > 5)
    command(rig, "pause")
    before = list_pulses(rig)
    rig.dimmer.set_share(0.05)
    command(rig, "resume")
    finish(rig, record)
    assert max(duty for _, _, duty in list_pulses(rig)[len(before) :]) <= 0.05 * 65535 < before[-1][2]
    assert record.build_report(0.0).summary.trimmed.pulses == record.pulse_count - len(before)


def drop_by_stop(rig):
    rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))
    return "ended by stop"


def drop_by_disarm(rig):
    rig.await_result(WEB, rig.request(WEB, "disarm"))
    return "ended by disarm"


def drop_by_fault(rig):
    rig.core.set_input("interlock", False, round(rig.clock.now_s() * 1e6))
    return "INTERLOCK"


def drop_by_time(rig):
    ServiceRig.run(rig, PAUSE_MAX_S - 1.0, 0.02)
    assert rig.session.board.state == BoardState.ARMED
    assert 0.0 < rig.of_kind(WEB, "status")[-1].fields["pause"]["ends_in_s"] < 1.0
    ServiceRig.run(rig, 1.0, 0.02)
    return "the light was paused for 300 s"


@pytest.mark.parametrize("drop", [drop_by_stop, drop_by_disarm, drop_by_fault, drop_by_time])
def test_a_paused_queue_is_dropped_and_resume_is_refused(rig, drop):
    record, waiting = submit(rig, build_train(2.0)), submit(rig, build_train(0.5))
    rig.until(lambda: record.executed_count > 5)
    command(rig, "pause")
    before = len(rig.list_emitted())
    reason = drop(rig)
    rig.run(0.1)
    for ended in (record, waiting):
        assert ended.status == ("stopped" if reason.startswith("ended by") else "failed")
        assert reason in ended.error
    assert record.executed_count == before == len(record.execution.start_s)
    result = rig.await_result(WEB, rig.request(WEB, "resume"))
    assert result["error"]["code"] == "not_ready"
    assert "only an armed board can be resumed" in result["error"]["message"]
    rig.core.set_input("interlock", True, round(rig.clock.now_s() * 1e6))
    rig.await_result(WEB, rig.request(WEB, "disarm"))
    rig.arm()
    rig.run(0.5)
    assert len(rig.list_emitted()) == before
    assert not rig.remote.is_held
    finish(rig, submit(rig, build_train(0.1)))
    assert len(rig.list_emitted()) > before


def test_only_an_armed_board_can_be_paused(rig):
    drop_by_disarm(rig)
    result = rig.await_result(WEB, rig.request(WEB, "pause"))
    assert (result["error"]["code"], result["pause"]["ends_in_s"]) == ("not_ready", None)
    assert "the board is DISARMED; only an armed board can be paused" in result["error"]["message"]
