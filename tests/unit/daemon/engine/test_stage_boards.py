"""Boards of several stages, driven as one: one time, one state, one end."""

import re

import numpy as np
import pytest

from displays import DISPLAYS
from link_service_rig import OPERATOR, WEB
from optodrive.core.errors import LinkError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.link.protocol.states import ARMED_STATES, BoardState
from optodrive.link.session import plan_job
from optodrive.link.simulator.board_core import BoardClock
from planner_rig import build_frame, build_train
from stage_rig import CLOCKS, BreakingLink, BusyLink, StageRig, build_stages

LEASE_S = DISPLAYS["display-16"].config.board.lease_s


def build_armed(monkeypatch, count, name="display-16", **changes):
    rig = StageRig(monkeypatch, build_stages(name, count, **changes)).ready()
    rig.run(2.0)
    rig.arm()
    rig.run(0.01)
    return rig


STAGES = (2, pytest.param(4, marks=pytest.mark.slow))
"""Four run the same code as two; tests of what depends on their number state it."""


@pytest.fixture(params=STAGES)
def rig(request, monkeypatch):
    return build_armed(monkeypatch, request.param)


@pytest.fixture(params=STAGES)
def wide_rig(request, monkeypatch):
    return build_armed(monkeypatch, request.param, "display-437")


def fill(height_um, pixels=range(437)):
    """Build a frame for a stream over 437 pixels."""
    return build_frame(height_um, pixels, 9.0, 437)


def submit(rig, sequence, streamed=False):
    return rig.store.find(rig.submit(sequence, rig.remote.epoch, streamed).result().plan)


def finish(rig, record):
    rig.until(lambda: record.has_ended, 300.0)
    return record


def run(rig, duration_s):
    """Let planner and link run."""
    until_s = rig.clock.now_s() + duration_s
    rig.until(lambda: rig.clock.now_s() >= until_s)


def build_trains(stages, seconds):
    """Build trains at the same time, one for each stage."""
    return FrameSequence((), tuple(PulseTrain(3 * k, 0.0, seconds, 0.02, 0.01, 1.0) for k in range(stages)))


def list_states(rig):
    return {core.state for core in rig.cores}


def check_beams(rig):
    """Assert by the boards' own logs that no two beams were on one pixel, that is, at the same codes, at a time."""
    pulses = rig.list_pulses()
    for codes in np.unique(pulses[:, 2:4], axis=0):
        on_s, off_s = pulses[(pulses[:, 2:4] == codes).all(axis=1)][:, :2].T
        assert (on_s[1:] > off_s[:-1]).all()


@pytest.mark.parametrize("rig", [2, 4], indirect=True)
def test_a_frame_is_drawn_by_all_boards_at_once(rig):
    record = finish(rig, submit(rig, build_frame(60.0)))
    assert (record.status, record.error, record.executed_count) == ("done", None, 16)
    pulses = rig.list_pulses()
    assert len(pulses) == 16
    assert set(pulses[:, 4]) == set(range(len(rig.logs)))
    columns = record.pulses.to_columns()
    assert columns.stage == record.execution.to_columns().stage
    assert sorted(columns.stage) == sorted(pulses[:, 4].tolist())
    assert record.execution.simulated_m == pytest.approx(np.full(16, 60e-6), rel=0.01)
    assert abs(record.timing_error.max_abs_s) < 1e-4
    check_beams(rig)


@pytest.mark.parametrize(
    ("rig", "duration_s"),
    [(2, 8.0), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((4, 8.0), (2, 40.0), (4, 40.0)))],
    indirect=["rig"],
)
def test_gates_keep_the_planned_times(rig, duration_s):
    record = submit(rig, build_trains(len(rig.cores), duration_s))
    plan = rig.queue.state.waiting[0].planned.plan
    finish(rig, record)
    begin_s = record.start_s + plan.start_s
    pulses = rig.list_pulses()
    errors_s = [pulses[pulses[:, 4] == stage][:, 0] - begin_s[plan.stage == stage] for stage in range(len(rig.cores))]
    assert max(np.abs(error_s).max() for error_s in errors_s) < 1e-4
    # All boards lag by the same half of an exchange.
    assert np.percentile(np.ptp(errors_s, axis=0), 99) < 2e-5
    assert record.delay_s == 0.0


def test_without_following_the_host_s_clock_they_drift_apart(monkeypatch):
    monkeypatch.setattr(plan_job.PlanJob, "_follow_host", lambda *_: None)
    rig = build_armed(monkeypatch, 2)
    finish(rig, submit(rig, build_trains(2, 8.0)))
    ends_s = [rig.list_pulses()[rig.list_pulses()[:, 4] == stage][-1, 0] for stage in range(2)]
    assert abs(ends_s[0] - ends_s[1]) > 6e-4


def test_a_streamed_frame_replaces_the_rest_on_all_boards_without_a_pause(wide_rig):
    rig = wide_rig
    first = submit(rig, fill(60.0), streamed=True)
    rig.until(lambda: first.executed_count > 20)
    second = submit(rig, fill(80.0), streamed=True)
    finish(rig, second)
    assert (first.status, second.status) == ("superseded", "done")
    assert first.executed_count + first.dropped == 437
    assert np.abs(second.execution.simulated_m - 80e-6).max() < 1e-6
    assert rig.boards.board.underruns == 0
    assert abs(second.timing_error.max_abs_s) < 1e-4
    pulses = rig.list_pulses()
    for stage in range(len(rig.cores)):
        on_s, off_s = pulses[pulses[:, 4] == stage][:, :2].T
        assert (on_s[1:] - off_s[:-1]).max() < 0.03
    check_beams(rig)


def test_many_frames_are_streamed(wide_rig):
    rig, rng, records = wide_rig, np.random.default_rng(4), []
    for _ in range(12):
        pixels = rng.choice(437, rng.integers(1, 200), replace=False)
        records.append(submit(rig, fill(rng.uniform(30.0, 90.0), pixels), streamed=True))
        run(rig, rng.uniform(0.002, 0.2))
    finish(rig, records[-1])
    assert [record.error for record in records if record.status not in ("superseded", "done")] == []
    assert all(record.executed_count + record.dropped == record.pulse_count for record in records)
    assert rig.boards.board.underruns == 0
    assert list_states(rig) <= set(ARMED_STATES)
    check_beams(rig)


@pytest.mark.parametrize("rig", [2, 4], indirect=True)
def test_stop_ends_the_light_of_all_boards(rig):
    record = submit(rig, build_trains(len(rig.cores), 3.0))
    rig.until(lambda: record.executed_count > 20)
    stopped_s = rig.clock.now_s()
    result = rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))
    assert result["error"] is None
    assert list_states(rig) == {BoardState.DISARMED}
    assert rig.list_pulses()[:, 1].max() < stopped_s + 0.002
    rig.run(0.1)
    assert (record.status, record.error) == ("stopped", "ended by stop")


def test_the_result_of_stop_waits_for_the_last_board(rig):
    record = submit(rig, build_trains(len(rig.cores), 3.0))
    rig.until(lambda: record.executed_count > 20)
    rig.links[-1].is_cut = True
    request = rig.request(OPERATOR, "stop")
    rig.run(0.05)
    assert rig.find_result(OPERATOR, request) is None
    assert rig.boards.board.state in ARMED_STATES
    rig.links[-1].is_cut = False
    assert rig.await_result(OPERATOR, request)["error"] is None


def build_breaking(monkeypatch):
    """Return three boards that draw, over links that may break."""
    rig = StageRig(monkeypatch, build_stages("display-16", 3), link_type=BreakingLink).ready()
    rig.run(2.0)
    rig.arm()
    record = submit(rig, build_trains(3, 9.0))
    rig.until(lambda: record.executed_count > 20)
    return rig


@pytest.mark.parametrize("lost_for_s", [0.05, 5.0])
def test_every_stage_is_listed_with_its_state_after_one_was_lost(monkeypatch, lost_for_s):
    """The links to the others stay open. A last known state of the lost board would be a claim."""
    rig = build_breaking(monkeypatch)
    rig.links[1].is_broken = True
    rig.cores[1].on_link_lost(rig.links[1]._now_us())
    rig.run(lost_for_s)
    stages = rig.remote.stages
    assert [stage["name"] for stage in stages] == ["s0", "s1", "s2"]
    assert [stage["connected"] for stage in stages] == [True, False, True]
    assert [stage["board"]["state"] for stage in stages] == ["DISARMED", "UNKNOWN", "DISARMED"]
    assert [stage["board"]["fault"] for stage in stages] == [None, None, None]
    assert (stages[0]["error"], stages[2]["error"]) == (None, None)
    assert "/dev/s1: unplugged" in stages[1]["error"]
    assert rig.remote.link_error.startswith("stage 's1': /dev/s1: unplugged")
    assert (stages[1]["clock_error_us"], stages[1]["clock_drift_ppm"]) == (None, None)
    rig.links[1].is_broken = False
    rig.until(lambda: rig.remote.connected)
    assert [stage["error"] for stage in rig.remote.stages] == [None, None, None]


def test_abort_goes_to_the_other_boards_in_the_step_that_finds_one_lost(monkeypatch):
    """They would also be aborted later, as boards without an arming, once they have acknowledged all that was sent."""
    rig = build_breaking(monkeypatch)
    rig.links[2].is_broken = True
    assert [core.state for core in rig.cores[:2]] == [BoardState.RUNNING] * 2
    with pytest.raises(LinkError, match="unplugged"):
        rig.boards.step(0.0, renew_lease=True)
    for session in rig.boards.sessions[:2]:
        session.step(0.0, renew_lease=True)
    assert [core.state for core in rig.cores[:2]] == [BoardState.DISARMED] * 2


def test_arming_is_of_all_boards_or_of_none(monkeypatch):
    rig = StageRig(monkeypatch, build_stages("display-16", 3)).ready()
    rig.cores[1].set_input("interlock", False, rig.links[1]._now_us())
    rig.run(0.5)
    result = rig.await_result(WEB, rig.request(WEB, "arm"))
    assert "stage 's1': the board is in FAULT INTERLOCK" in str(result["error"])
    rig.run(3.0)
    assert not list_states(rig) & set(ARMED_STATES)


def test_light_that_would_be_late_is_not_emitted_and_the_rest_is_planned_anew(wide_rig):
    """Boards that execute points late would no longer agree about the order of their pulses."""
    rig = wide_rig
    record = submit(rig, fill(60.0), streamed=True)
    rig.until(lambda: record.executed_count > 20)
    rig.clock.sleep(0.8 * LEASE_S)  # longer than points are sent ahead
    rig.until(lambda: list_states(rig) == {BoardState.ARMED})
    assert len(rig.list_pulses()) < 437
    assert finish(rig, record).status == "done"
    assert record.executed_count == len(rig.list_pulses())
    assert record.execution.simulated_m == pytest.approx(np.full(record.executed_count, 60e-6), rel=0.01)
    assert abs(record.timing_error.max_abs_s) < 1e-4


@pytest.mark.parametrize("resumed_s", [0.001, 0.008])
def test_light_after_a_board_ran_out_of_points_is_late_and_planned_anew(rig, resumed_s):
    """The host goes on before the gate of the next point is due, which the board has not begun in time."""
    record = submit(rig, build_trains(len(rig.cores), 9.0), streamed=True)
    rig.until(lambda: record.executed_count > 20)
    while BoardState.HOLD not in list_states(rig):
        rig.clock.sleep(0.001)
        for core, link in zip(rig.cores, rig.links, strict=True):
            core.advance(link._now_us())
    rig.clock.sleep(resumed_s)
    rig.until(lambda: list_states(rig) == {BoardState.ARMED})
    finish(rig, record)
    assert (record.status, record.executed_count) == ("done", len(rig.list_pulses()))
    assert abs(record.timing_error.max_abs_s) < 1e-4


def test_a_board_whose_clock_is_not_known_well_enough_refuses_the_start(monkeypatch):
    rig = build_armed(monkeypatch, 2, stage_skew_max_s=1e-6)
    record = finish(rig, submit(rig, build_train(1.0)))
    assert record.status == "failed"
    assert re.search(r"stage 's0': after 3.\d s of repeated exchanges its clock is known to \d+ µs", record.error)
    assert "stage_skew_max_s permits 1 µs" in record.error
    assert not len(rig.list_pulses())


def build_busy(monkeypatch, delay_s=0.004):
    """Build armed boards.

    delay_s: of all that arrives from the second. By default a start needs narrower exchanges.
    """
    rig = StageRig(monkeypatch, build_stages("display-16", 2), link_type=BusyLink)
    rig.links[1].delay_s = delay_s
    rig.ready()
    rig.arm()
    rig.run(0.01)
    return rig


@pytest.mark.parametrize("streamed", [False, True])
def test_a_start_waits_until_an_exchange_is_narrow_enough(monkeypatch, streamed):
    """The plan is then proven again for its new time. The error is that of the best exchange, not of the last."""
    rig = build_busy(monkeypatch)
    record = submit(rig, build_frame(60.0), streamed)
    planned_s = record.start_s
    run(rig, 1.0)
    assert (record.status, len(rig.list_pulses())) == ("queued", 0)
    rig.links[1].delay_s = 0.0
    run(rig, 0.03)
    rig.links[1].delay_s = 0.004
    finish(rig, record)
    assert (record.status, record.error, record.executed_count) == ("done", None, 16)
    assert record.start_s > planned_s + 1.0
    assert abs(record.timing_error.max_abs_s) < 1e-3
    assert record.execution.simulated_m == pytest.approx(np.full(16, 60e-6), rel=0.01)
    check_beams(rig)


def test_a_start_that_waits_in_vain_is_refused_and_stop_ends_the_wait(monkeypatch):
    rig = build_busy(monkeypatch)
    record, second = (submit(rig, build_frame(60.0)) for _ in range(2))
    finish(rig, record)
    assert re.search(r"stage 's1': after 3.\d s of repeated exchanges its clock is known to \d{4} µs", record.error)
    assert rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))["error"] is None
    run(rig, 0.01)
    assert (second.status, second.error) == ("stopped", "ended by stop")
    assert not len(rig.list_pulses())


def test_a_plan_that_goes_on_after_a_pause_waits_for_the_clocks_too(monkeypatch):
    rig = build_busy(monkeypatch, 0.0)
    record = submit(rig, build_trains(2, 2.0))
    rig.until(lambda: record.executed_count > 20)
    assert rig.await_result(WEB, rig.request(WEB, "pause"))["error"] is None
    rig.links[1].delay_s = 0.004
    while rig.boards.list_stages()[1]["clock_error_us"] < 1000.0:
        run(rig, 0.1)
    count = len(rig.list_pulses())
    assert rig.await_result(WEB, rig.request(WEB, "resume"))["error"] is None
    run(rig, 1.0)
    assert len(rig.list_pulses()) == count
    rig.links[1].delay_s = 0.0
    finish(rig, record)
    assert (record.status, record.error) == ("done", None)
    assert abs(record.timing_error.max_abs_s) < 1e-3
    assert len(rig.list_pulses()) == record.executed_count


def test_a_board_whose_clock_drifts_beyond_what_can_be_followed_refuses_the_start(monkeypatch):
    clocks = CLOCKS[0], BoardClock(1e-3)
    rig = StageRig(monkeypatch, build_stages("display-16", 2, stage_skew_max_s=0.01), clocks).ready()
    rig.run(4.0)
    rig.arm()
    rig.run(0.01)
    record = finish(rig, submit(rig, build_train(1.0)))
    assert record.status == "failed"
    assert re.search(r"stage 's1': its clock drifts by \+(99\d|1000) ppm, at most 200 ppm can be", record.error)
    assert not len(rig.list_pulses())


def test_a_splice_of_points_that_are_not_those_verified_is_refused(wide_rig):
    rig = wide_rig
    first = submit(rig, fill(60.0), streamed=True)
    rig.until(lambda: first.executed_count > 20)
    plan = rig.queue.state.running[0].plan
    kept = [count // 2 for count in plan.points.counts]
    assert rig.remote.splice(plan.points, kept, first.start_s + 1.0, rig.remote.epoch, 0.05, plan.crc ^ 1) is None
    assert "CRC-32" in rig.remote.pop_refusal()
