"""One stage is lost, where the others go on: commands, pauses and streams meanwhile, and what ends it."""

import numpy as np
import pytest

from link_service_rig import OPERATOR, WEB
from optodrive.core.errors import NotReadyError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.daemon.engine.plan_rest import DURATION_MIN_S, build_rest_sequence
from optodrive.daemon.engine.telemetry_events import ExecutedBatch
from optodrive.link.protocol.states import BoardState
from optodrive.link.session.board_group import BoardGroup
from optodrive.planning.pipeline import plan_sequence
from planner_rig import build_frame
from stage_loss_rig import LossRig
from stage_rig import build_stages

DARK_S = 0.004
"""Time from what ends the light until the last gate is off."""


def build_trains(seconds=2.0):
    return FrameSequence((), tuple(PulseTrain(3 * k, 0.0, seconds, 0.005, 0.045, 1.0) for k in range(3)))


@pytest.fixture
def rig(monkeypatch):
    return LossRig(monkeypatch, 3)


def lose(rig, kind="fault", stage=1):
    """Let trains begin on all boards and lose one. Return the record of the plan."""
    record = rig.push(build_trains())
    rig.until(lambda: record.executed_count > 6)
    rig.lose(stage, kind)
    rig.until(lambda: rig.remote.lost is not None)
    return record


def list_states(rig):
    return [core.state for core in rig.cores]


def find_last_light_s(rig):
    emitted = rig.collect_emitted()
    return float((emitted.start_s + emitted.width_s).max())


@pytest.mark.parametrize(("kind", "cause"), [("fault", "went to FAULT (INTERLOCK)"), ("unplug", "/dev/s1: unplugged")])
def test_the_status_shows_the_lost_stage_with_its_cause_and_the_others_as_before(rig, kind, cause):
    record = lose(rig, kind)
    rig.sleep(0.3)
    lost = [stage["lost"] for stage in rig.remote.stages]
    assert (lost[0], lost[2]) == (None, None)
    assert cause in lost[1]
    assert rig.remote.connected
    assert rig.remote.link_error is None
    assert rig.remote.board.state == BoardState.RUNNING
    assert record.status == "running"


def test_a_command_that_ends_the_light_waits_for_the_lost_board_while_its_link_is_up(rig):
    lose(rig, "fault")
    link = rig.links[1]
    link.kind = "cut"  # it does not answer, and its link does not count as lost yet
    rig.run(0.03)
    assert rig.boards.sessions[1].connected
    request = rig.request(OPERATOR, "stop")
    rig.run(0.03)
    assert list_states(rig)[::2] == [BoardState.DISARMED] * 2
    assert rig.find_result(OPERATOR, request) is None
    link.kind = ""
    assert rig.await_result(OPERATOR, request)["error"] is None


def test_a_stop_that_forgets_the_lost_board_is_caught(rig, monkeypatch):
    lose(rig, "fault")
    monkeypatch.setattr(BoardGroup, "has_lost_ended", True)
    rig.links[1].kind = "cut"
    rig.run(0.03)
    request = rig.request(OPERATOR, "stop")
    rig.run(0.03)
    assert rig.find_result(OPERATOR, request)["error"] is None


@pytest.mark.parametrize("kind", ["unplug", "fault"])
def test_stop_ends_the_light_of_the_others_and_all_are_needed_to_arm_again(rig, kind):
    record = lose(rig, kind)
    rig.sleep(0.4)
    stopped_s = rig.clock.now_s()
    assert rig.stop()["error"] is None
    assert list_states(rig)[::2] == [BoardState.DISARMED] * 2
    assert find_last_light_s(rig) < stopped_s + DARK_S
    rig.sleep(0.1)
    assert (record.status, record.error) == ("stopped", "ended by stop")
    result = rig.await_result(WEB, rig.request(WEB, "arm"))
    assert "stage 's1'" in result["error"]["message"]
    rig.restore(1)
    again = rig.push(build_frame(60.0))
    rig.until(lambda: again.has_ended)
    assert (again.status, again.executed_count) == ("done", 16)
    assert set(again.execution.stage.tolist()) == {0, 1, 2}


def test_the_loss_of_a_second_stage_ends_the_light_of_all(rig):
    record = lose(rig, "unplug", 1)
    rig.sleep(0.4)
    lost_s = rig.lose(0, "fault")
    rig.sleep(0.1)
    assert record.status == "failed"
    assert "stage 's0' went to FAULT" in rig.remote.epoch_reason
    assert find_last_light_s(rig) < lost_s + DARK_S
    assert rig.cores[2].state == BoardState.DISARMED


def test_a_board_that_is_lost_before_all_are_armed_leaves_none_armed(rig):
    assert rig.stop()["error"] is None
    rig.request(WEB, "arm")
    rig.sleep(1.0)
    rig.lose(2, "fault")
    rig.sleep(2.0)
    assert list_states(rig) == [BoardState.DISARMED, BoardState.DISARMED, BoardState.FAULT]


def test_points_for_the_lost_board_are_refused(rig):
    points = []
    begin = rig.remote.begin
    rig.remote.begin = lambda *arguments: points.append(arguments) or begin(*arguments)
    lose(rig)
    rig.until(lambda: len(points) == 2 and rig.remote.is_ready)
    before, after = points[0][0], points[1][0]
    assert [len(each) > 0 for each in after.stages] == [True, False, True]
    begin(before, rig.clock.now_s() + 0.05, rig.remote.epoch)
    rig.run(0.01)
    assert "stage 's1' was lost: the board went to FAULT" in rig.find_refusals()[-1]


@pytest.mark.parametrize("paused_first", [False, True])
def test_a_pause_and_a_loss_at_one_time_light_each_pulse_once(rig, paused_first):
    record = rig.push(build_trains())
    planned = record.pulse_count
    rig.until(lambda: record.executed_count > 6)
    if paused_first:
        rig.await_result(WEB, rig.request(WEB, "pause"))
        rig.sleep(0.3)
        rig.lose(1, "fault")
    else:
        rig.lose(1, "fault")
        rig.run(0.02)
        rig.await_result(WEB, rig.request(WEB, "pause"))
    paused_s = rig.clock.now_s()
    rig.sleep(1.0)
    assert find_last_light_s(rig) < paused_s + DARK_S
    with pytest.raises(NotReadyError, match="paused"):
        rig.push(build_frame(60.0), streamed=True)
    rig.await_result(WEB, rig.request(WEB, "resume"))
    rig.until(lambda: record.has_ended)
    emitted = rig.collect_emitted()
    assert record.status == "done"
    counts = np.bincount(emitted.pixel, minlength=7)[[0, 3, 6]]
    assert (counts <= 40).all()
    assert counts.sum() >= planned - 8  # the lost board had been sent these for 0.16 s
    assert not (emitted.stage[emitted.start_s > paused_s] == 1).any()


def test_a_frame_of_a_stream_that_comes_while_all_are_dark_replaces_the_one_before(rig):
    first = rig.push(build_frame(150.0), streamed=True)
    rig.until(lambda: first.executed_count > 2)
    rig.lose(1, "unplug")
    rig.run(0.02)
    assert rig.remote.is_interrupted
    second = rig.push(build_frame(60.0, [1, 2]), streamed=True)
    third = rig.push(build_frame(60.0, [5, 6]), streamed=True)
    rig.until(lambda: third.has_ended)
    assert [record.status for record in (first, second, third)] == ["superseded", "superseded", "done"]
    assert first.executed_count + first.dropped <= first.pulse_count
    assert third.execution.simulated_m == pytest.approx(np.full(third.pulse_count, 60e-6), rel=0.01)
    emitted = rig.collect_emitted()
    assert set(emitted.pixel[emitted.start_s > rig.remote.dark_s].tolist()) == {5, 6}


def test_the_rest_of_a_streamed_frame_is_drawn_and_a_newer_one_cuts_it(rig):
    first = rig.push(build_frame(150.0), streamed=True)
    rig.until(lambda: first.executed_count > 2)
    rig.lose(1, "fault")
    rig.until(lambda: rig.clock.now_s() > rig.remote.dark_s and len(rig.queue.state.running) == 1)
    executed = first.executed_count
    rig.until(lambda: first.executed_count > executed + 2)
    second = rig.push(build_frame(80.0, [0, 1, 2]), streamed=True)
    rig.until(lambda: second.has_ended)
    assert (first.status, second.status, second.executed_count) == ("superseded", "done", 3)
    assert second.execution.simulated_m.max() == pytest.approx(80e-6, rel=0.2)
    assert rig.boards.board.underruns == 0


def test_a_plan_that_waits_is_planned_anew_for_the_others(rig):
    lose(rig)
    waiting = rig.push(build_frame(60.0))
    rig.until(lambda: waiting.has_ended)
    assert (waiting.status, waiting.executed_count) == ("done", 16)
    assert set(waiting.execution.stage.tolist()) == {0, 2}
    assert waiting.execution.simulated_m == pytest.approx(np.full(16, 60e-6), rel=0.01)
    totals = rig.queue.accounts.totals
    assert totals["planned"] == sum(record.pulse_count for record in rig.store.list_recent())


def test_the_telemetry_gets_each_executed_pulse_with_its_pixel(rig):
    record = lose(rig)
    rig.until(lambda: record.has_ended)
    batches = [ExecutedBatch.from_progress(event, rig.remote.scales).pulses for event in rig.queue.accounts.events]
    names = "start_s", "pixel", "stage"
    start_s, pixel, stage = (np.concatenate([getattr(batch, name) for batch in batches]) for name in names)
    assert len(start_s) == record.executed_count
    emitted = rig.collect_emitted()
    nearest = np.abs(emitted.start_s[None, :] - start_s[:, None]) < 2e-3
    nearest &= emitted.stage[None, :] == stage[:, None]
    assert [pixel[k] in emitted.pixel[nearest[k]] for k in range(len(pixel))] == [True] * len(pixel)


# --- what is left of a plan

DISPLAY = build_stages("display-16", 2)


def plan(sequence):
    return plan_sequence(DISPLAY, sequence, *DISPLAY.build_cold_state())


def test_a_frame_keeps_the_pixels_that_were_not_drawn_and_its_rhythm():
    target_m = np.full(16, 60e-6)
    frames = tuple(TactileFrame(str(k), 0.5 * k, 0.4, target_m) for k in range(3))
    planned = plan(FrameSequence(frames))
    first_row, rows = 21, planned.plan
    sequence, sources = build_rest_sequence(planned, first_row, float(rows.start_s[first_row]))
    assert sources.tolist() == [1, 2]
    second, third = sequence.frames
    assert set(np.flatnonzero(second.target_m)) == set(rows.pixel[first_row:32].tolist())
    assert (second.show_at_s, second.frame_id) == (0.0, "1")
    assert third.show_at_s == pytest.approx(float(rows.start_s[32] - rows.start_s[first_row]))
    assert (third.target_m == target_m).all()
    assert DURATION_MIN_S < second.duration_s < 0.4


def test_a_frame_whose_time_is_over_is_still_drawn():
    planned = plan(build_frame(60.0, duration_s=0.02))
    sequence, _ = build_rest_sequence(planned, 12, 5.0)
    assert (sequence.frames[0].show_at_s, sequence.frames[0].duration_s) == (0.0, DURATION_MIN_S)


def test_a_train_keeps_the_cycles_of_which_nothing_was_emitted():
    trains = PulseTrain(2, 0.1, 1.0, 0.01, 0.04, 1.0), HeightTrain(9, 0.0, 1.0, 0.1, 40e-6)
    planned = plan(FrameSequence((), trains))
    rows, source = planned.plan, planned.plan.source
    first_row = int(np.flatnonzero(rows.start_s > 0.42)[0])
    sequence, sources = build_rest_sequence(planned, first_row, float(rows.start_s[first_row]))
    assert sources.tolist() == [0, 1]
    left = [np.count_nonzero(source[first_row:] == number) for number in range(2)]
    assert [len(train.pulse_starts_s()) for train in sequence.trains] == [left[0], pytest.approx(left[1], abs=1)]
    assert sequence.trains[0].duration_s == pytest.approx(0.05 * left[0])
    assert min(train.start_s for train in sequence.trains) == 0.0


def test_nothing_is_left_of_a_train_whose_last_cycle_was_begun():
    planned = plan(FrameSequence((), (HeightTrain(9, 0.0, 0.3, 0.1, 40e-6),)))
    sequence, sources = build_rest_sequence(planned, len(planned.plan), 0.5)
    assert (sequence, len(sources)) == (FrameSequence(), 0)


def test_a_simultaneous_frame_is_raised_to_its_height_by_the_others(rig):
    target_m = np.zeros(16)
    target_m[:6] = 150e-6
    record = rig.push(FrameSequence((TactileFrame("f", 0.0, 1.0, target_m, simultaneous=True),)))
    rig.until(lambda: record.executed_count > 1)
    rig.lose(0, "fault")
    rig.until(lambda: record.has_ended)
    assert record.status == "done"
    execution, last_m = record.execution, {}
    for pixel, stage, height_m in zip(execution.pixel, execution.stage, execution.simulated_m, strict=True):
        if stage:
            last_m[int(pixel)] = float(height_m)
    assert sorted(last_m.values()) == pytest.approx([150e-6] * 4, rel=0.02)


def test_two_stages_that_are_left_of_three_share_a_frame_as_two_do():
    display, two = build_stages("display-437", 3), build_stages("display-437", 2)
    sequence = build_frame(60.0, range(437), 9.0, 437)
    ends_s = []
    for each in (display.without_stage(1), two):
        planned = plan_sequence(each, sequence, *each.build_cold_state())
        ends_s.append(planned.duration_s)
        assert set(planned.plan.stage.tolist()) == set(np.flatnonzero(each.draws).tolist())
    assert ends_s[0] <= 1.01 * ends_s[1]
