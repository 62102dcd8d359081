"""Queue and planner over a real link service in virtual time: epochs, streams, cancelling, clocks."""

import threading
from math import inf

import pytest

from link_service_rig import OPERATOR, PLANNER, WEB, ServiceRig
from optodrive.core.errors import BusyError, InputError, StoppedError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine import plan_queue, planner
from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.daemon.engine.planner import PLANNING_MAX_S, REQUESTS_MAX
from optodrive.daemon.engine.queue_state import PlanRun
from optodrive.planning.pulse_table import PulseTable
from planner_rig import PlannerRig, build_frame, build_train
from standing_rig import StandingRig, build_display, build_page


def submit(rig, sequence, streamed=False, caller="", **options):
    return rig.store.find(rig.submit(sequence, rig.remote.epoch, streamed, caller, **options).result().plan)


def finish(rig, record):
    rig.until(lambda: record.has_ended)
    return record


def stop(rig):
    rig.await_result(OPERATOR, rig.request(OPERATOR, "stop"))
    rig.run(0.01)


def test_plans_are_executed_in_order_with_the_points_that_were_proven(rig):
    first, second = submit(rig, build_frame(60.0)), submit(rig, build_frame(90.0))
    finish(rig, second)
    assert (first.status, second.status) == ("done", "done")
    assert first.executed_count == second.executed_count == 16
    assert len(rig.list_emitted()) == 32
    assert second.execution.simulated_max_m == pytest.approx(90e-6, rel=0.01)


def test_no_report_states_an_end_without_the_execution(rig, monkeypatch):
    """The plan ends in another thread while its report is built."""
    record, to_columns = submit(rig, build_frame(60.0)), PulseTable.to_columns
    rig.until(lambda: record.executed_count >= 1)

    def end_now(pulses):
        finish(rig, record)
        return to_columns(pulses)

    monkeypatch.setattr(PulseTable, "to_columns", end_now)
    report = record.build_report(0.0)
    assert record.has_ended
    assert report.status == "running"
    assert record.build_report(0.0).executed_pulses is not None


def test_a_streamed_plan_replaces_the_unsent_rest_without_a_pause(rig):
    first = submit(rig, build_frame(60.0, duration_s=9.0), streamed=True)
    rig.until(lambda: first.executed_count >= 1)
    second = submit(rig, build_frame(80.0, duration_s=9.0), streamed=True)
    finish(rig, second)
    assert (first.status, second.status) == ("superseded", "done")
    assert first.executed_count + first.dropped == 16
    assert rig.session.board.underruns == 0


def test_an_empty_frame_ends_the_one_before(rig):
    first = submit(rig, build_frame(300.0, duration_s=9.0), streamed=True)
    rig.until(lambda: first.executed_count >= 1)
    nothing = finish(rig, submit(rig, build_frame(300.0, (), duration_s=9.0), streamed=True))
    assert (finish(rig, first).status, nothing.status) == ("superseded", "done")
    assert len(rig.list_emitted()) == first.executed_count < 16


def test_a_refresh_that_has_not_begun_is_replaced_as_a_whole(rig):
    first = submit(rig, build_frame(60.0, duration_s=9.0), streamed=True)
    rig.until(lambda: first.executed_count >= 1)
    heights_um = (80.0, 90.0)
    second, third = (
        submit(rig, build_frame(each, duration_s=9.0), streamed=True, refreshes=True) for each in heights_um
    )
    assert (second.dropped, third.start_s) == (16, second.start_s)
    finish(rig, third)
    assert [record.status for record in (first, second, third)] == ["superseded", "superseded", "done"]
    assert (first.executed_count + first.dropped, second.executed_count, third.executed_count) == (16, 0, 16)
    assert len(rig.list_emitted()) == first.executed_count + 16
    assert third.execution.simulated_m == pytest.approx(90e-6, rel=0.01)
    assert rig.session.board.underruns == 0


def test_a_frame_that_has_not_begun_keeps_a_pulse(rig):
    """Its first point may have left."""
    first = submit(rig, build_frame(60.0, duration_s=9.0), streamed=True)
    rig.until(lambda: first.executed_count >= 1)
    second, third = (submit(rig, build_frame(height_um, duration_s=9.0), streamed=True) for height_um in (80.0, 90.0))
    assert (second.dropped, third.start_s > second.start_s) == (15, True)
    finish(rig, third)
    assert (second.executed_count, third.executed_count) == (1, 16)


@pytest.mark.parametrize("refreshes", [True, False])
def test_light_of_a_refresh_counts_from_the_fingers_of_the_one_that_it_replaced_as_a_whole(rig, refreshes):
    first = submit(rig, build_frame(60.0, duration_s=9.0), streamed=True)
    rig.until(lambda: first.executed_count >= 1)
    second = submit(rig, build_frame(80.0, duration_s=9.0), streamed=True, refreshes=True)
    *before, (plan, job) = rig.queue.state.running
    plan = plan.note(arrived_s=second.arrived_s - 0.005)
    rig.queue._apply(rig.queue.state.update_runs([*before, PlanRun(plan, job)]))
    third = submit(rig, build_frame(90.0, duration_s=9.0), streamed=True, refreshes=refreshes)
    assert second.dropped == 16
    assert third.arrived_s - second.arrived_s == pytest.approx(0.0 if refreshes else 0.005)
    assert third.planned_after_s == 0.0
    finish(rig, third)
    light_s = third.start_s + third.first_pulse_s
    assert third.arrived_s + third.first_light_after_s == pytest.approx(light_s, abs=1e-4)


@pytest.fixture
def attempts(monkeypatch):
    """The identifiers of the plans that are made, one for each attempt."""
    made, make_plan = [], planner.make_plan

    def count_plan(*arguments):
        made.append(arguments[5])
        return make_plan(*arguments)

    monkeypatch.setattr(planner, "make_plan", count_plan)
    return made


def show_after_another(rig, delays_s, streamed):
    """Show a frame on a warm pixel, with delays between planning and commit. Return its record."""
    first = submit(rig, build_frame(300.0, (5,), 0.02), streamed)
    rig.until(lambda: first.executed_count == 1)
    left = list(delays_s)

    def sleep():
        if left:
            ServiceRig.run(rig, left.pop(0))

    rig.before_loop_action = sleep
    return finish(rig, submit(rig, build_frame(300.0, (5,), 0.02), streamed))


@pytest.mark.parametrize("streamed", [True, False])
def test_a_plan_whose_pixels_have_cooled_is_made_again(rig, attempts, streamed):
    record = show_after_another(rig, [0.08], streamed)
    assert attempts == ["p1", "p2", "p2"]
    assert record.execution.simulated_m == pytest.approx([300e-6], rel=0.01)


@pytest.mark.parametrize("streamed", [True, False])
def test_on_cold_pixels_a_late_plan_is_as_good(rig, attempts, streamed):
    rig.before_loop_action = lambda: ServiceRig.run(rig, 0.5)
    record = finish(rig, submit(rig, build_frame(300.0, (5,), 0.02), streamed))
    assert attempts == ["p1"]
    assert record.execution.simulated_m == pytest.approx([300e-6], rel=0.01)


@pytest.mark.parametrize("warm", [False, True])
@pytest.mark.parametrize("stall_s", [0.0, 0.07])
def test_the_report_states_by_how_much_a_plan_began_later_than_it_was_accepted_for(rig, stall_s, warm):
    """After a stall between acceptance and start, light moves on cold pixels, and is planned anew on warm ones."""
    if warm:
        first = submit(rig, build_frame(300.0, (5,), 0.02))
        rig.until(lambda: first.executed_count == 1)
    accepted = submit(rig, build_frame(300.0, (5,), 0.02))
    planned_s, first_pulse_s = accepted.start_s, accepted.first_pulse_s
    rig.clock.sleep(stall_s)
    record = finish(rig, accepted)
    light_s = record.arrived_s + record.first_light_after_s
    delay_s = record.build_report(0.0).delay_s
    assert delay_s == pytest.approx(light_s - (planned_s + first_pulse_s), abs=1e-4)
    assert (delay_s > 0.02) == (stall_s > 0.0)


@pytest.mark.parametrize("streamed", [True, False])
def test_a_plan_that_is_late_again_and_again_is_made_until_it_is_in_time(rig, attempts, streamed):
    record = show_after_another(rig, [0.08, 0.1, 0.12], streamed)
    assert (record.status, len(attempts)) == ("done", 4 if streamed else 3)  # of a plan it reserves what the first took
    assert record.execution.simulated_m == pytest.approx([300e-6], rel=0.01)


@pytest.mark.parametrize("streamed", [True, False])
def test_without_the_bound_on_cooling_a_late_bump_is_too_low_and_telemetry_says_so(rig, monkeypatch, streamed):
    monkeypatch.setattr(plan_queue, "COOLING_MAX_M", inf)
    record = show_after_another(rig, [0.08], streamed)
    assert record.execution.simulated_m < 0.97 * 300e-6


def test_stop_ends_running_and_waiting_plans_and_says_so(rig):
    running, waiting = submit(rig, build_train(3.0)), submit(rig, build_frame())
    rig.until(lambda: running.executed_count > 5)
    stop(rig)
    assert [record.status for record in (running, waiting)] == ["stopped", "stopped"]
    assert running.error == waiting.error == "ended by stop"
    count = len(rig.list_emitted())
    rig.arm()
    rig.run(1.0)
    assert len(rig.list_emitted()) == count


def test_pulses_that_are_reported_together_with_a_stop_count_as_executed(rig):
    record = submit(rig, build_train(3.0))
    rig.until(lambda: record.executed_count > 5)
    counted = record.executed_count
    ServiceRig.run(rig, 0.1)  # without the planner's loop, to which the reports come together with the new epoch
    stop(rig)
    assert record.executed_count == len(record.execution.start_s) > counted
    assert rig.queue.accounts.totals["executed"] == record.executed_count


def test_a_request_from_before_stop_is_answered_stopped_and_never_lights(rig):
    epoch = rig.remote.epoch
    stop(rig)
    rig.arm()
    rig.run(0.01)
    with pytest.raises(StoppedError, match="ended by stop"):
        rig.submit(build_frame(), epoch).result()
    rig.run(1.0)
    assert not rig.list_emitted()


def stop_and_arm_before_commit(rig):
    """Submit a plan, and stop and arm between its planning and its commit."""

    def stop_and_arm():
        rig.before_loop_action = lambda: None
        stop(rig)
        rig.arm()
        rig.run(0.01)

    rig.before_loop_action = stop_and_arm
    return rig.submit(build_frame(), rig.remote.epoch)


def test_stop_between_planning_and_commit_is_answered_stopped(rig):
    with pytest.raises(StoppedError, match="ended by stop"):
        stop_and_arm_before_commit(rig).result()
    rig.run(1.0)
    assert not rig.list_emitted()
    assert finish(rig, submit(rig, build_frame())).status == "done"


class UncheckedQueue(PlanQueue):
    """Mutant: accepts plans of every epoch."""

    def require_epoch(self, epoch):
        """Permit every epoch."""


def test_without_the_check_at_commit_such_a_plan_is_accepted_but_the_link_refuses_its_points(monkeypatch):
    rig = PlannerRig(monkeypatch, queue_type=UncheckedQueue).ready()
    rig.arm()
    rig.run(0.01)
    report = stop_and_arm_before_commit(rig).result()
    record = finish(rig, rig.store.find(report.plan))
    assert record.status == "failed"
    assert "epoch" in record.error
    assert not rig.list_emitted()


def test_a_streamed_request_from_before_stop_preempts_nothing(rig):
    epoch = rig.remote.epoch
    stop(rig)
    rig.arm()
    rig.run(0.01)
    running = submit(rig, build_train(0.5))
    rig.until(lambda: running.executed_count > 3)
    with pytest.raises(StoppedError):
        rig.submit(build_frame(), epoch, streamed=True).result()
    assert finish(rig, running).status == "done"


def test_a_request_whose_caller_left_is_not_committed(rig):
    left = threading.Event()
    left.set()
    with pytest.raises(StoppedError, match="left"):
        rig.submit(build_frame(), rig.remote.epoch, caller_left=left).result()
    assert not rig.queue.is_busy


def test_a_request_that_is_planned_for_too_long_is_refused(rig, monkeypatch):
    times_s = iter([0.0, 0.0, 1.0, PLANNING_MAX_S + 1.0])
    monkeypatch.setattr(planner, "thread_time", lambda: next(times_s))
    with pytest.raises(InputError, match="planned within 60 s of processor time"):
        rig.submit(build_frame(), rig.remote.epoch).result()
    assert not rig.queue.is_busy


def test_too_many_waiting_requests_are_refused(rig):
    rig.planner._pending_count = REQUESTS_MAX + 1
    with pytest.raises(BusyError, match="too many requests wait"):
        rig.submit(build_frame(), rig.remote.epoch)


def test_a_cancelled_plan_ends_and_the_next_one_runs(rig):
    running, waiting = submit(rig, build_train(3.0)), submit(rig, build_frame())
    rig.until(lambda: running.executed_count > 5)
    rig.queue.cancel(running)
    assert (running.status, running.error) == ("cancelled", "cancelled while running")
    assert finish(rig, waiting).status == "done"
    assert rig.session.board.state == "ARMED"


@pytest.mark.parametrize("caller", ["ann", "ben"])
def test_the_plans_of_a_revoked_caller_end_and_the_others_run(rig, caller):
    plans = [submit(rig, build_train(1.0), caller="ann"), submit(rig, build_frame(), caller="ben")]
    plans.append(submit(rig, build_frame(), caller="ann"))
    rig.until(lambda: plans[0].executed_count > 5)
    rig.queue.revoke(caller)
    emitted = len(rig.list_emitted())
    finish(rig, plans[1 if caller == "ann" else 2])
    of_caller = [plan for plan in plans if plan.caller == caller]
    assert {(plan.status, plan.error) for plan in of_caller} == {("cancelled", f"the token '{caller}' was revoked")}
    assert {plan.status for plan in plans if plan.caller != caller} == {"done"}
    if caller == "ann":
        assert len(rig.list_emitted()) <= emitted + 2 + plans[1].executed_count
    assert rig.session.board.state == "ARMED"


def revoke_before_commit(rig):
    """Submit a plan of ann, and revoke her token between its planning and its commit."""

    def revoke():
        rig.before_loop_action = lambda: None
        rig.queue.revoke("ann")

    rig.before_loop_action = revoke
    return rig.submit(build_frame(), rig.remote.epoch, caller="ann")


def test_a_request_from_before_the_revocation_of_its_token_is_refused(rig):
    with pytest.raises(StoppedError, match="the token 'ann' was revoked"):
        revoke_before_commit(rig).result()
    assert not rig.queue.is_busy
    rig.run(0.01)
    assert finish(rig, submit(rig, build_frame(), caller="ann")).status == "done"  # of a new token with her name


def test_without_the_time_of_the_revocation_such_a_request_is_lit(rig, monkeypatch):
    """Mutant: forgets who was revoked."""
    monkeypatch.setattr(PlanQueue, "_require_valid", lambda self, caller, arrived_s: None)
    record = rig.store.find(revoke_before_commit(rig).result().plan)
    assert finish(rig, record).executed_count


@pytest.mark.parametrize("client", [WEB, PLANNER])
def test_the_loss_of_a_process_ends_all_plans(rig, client):
    running = submit(rig, build_train(3.0))
    rig.until(lambda: running.executed_count > 5)
    if client == PLANNER:
        rig.remote.connection.close()
        rig.loop_once()
    else:
        rig.leave(client)
        rig.run(0.05)
    assert running.status == "failed"
    assert "process" in running.error
    count = len(rig.list_emitted())
    ServiceRig.run(rig, 1.0)  # without the planner's loop
    assert len(rig.list_emitted()) <= count + 1


def test_heat_and_budget_follow_a_restart_of_the_board_s_clock(rig):
    finish(rig, submit(rig, build_frame(90.0)))
    before, now_s = rig.queue.make_snapshot(False, 0.0), rig.remote.board_s()
    stop(rig)
    rig.queue.on_board_restarted(-now_s)
    after = rig.queue.make_snapshot(False, 0.0)
    assert float(after.thermal.budget.at_s - before.thermal.budget.at_s) == pytest.approx(-now_s)


def test_a_plan_may_follow_a_new_link_process_at_once(rig):
    record = submit(rig, build_train(3.0))
    rig.until(lambda: record.executed_count > 5)
    rig.queue.end_epoch("the link process has ended")  # up to a lease from now pulses may have started
    rig.queue.on_board_restarted(0.0)
    assert finish(rig, submit(rig, build_frame(60.0))).status == "done"


def test_an_empty_plan_is_done_at_once(rig):
    assert finish(rig, submit(rig, build_frame(0.0))).status == "done"


def test_pulses_that_caps_leave_without_light_are_no_delay(monkeypatch):
    """The board reports their points at the end."""
    display = build_display(display_mean_power_max_w=0.05)
    rig = StandingRig(monkeypatch, display).ready()
    rig.arm()
    rig.run(0.02)
    page_m = build_page(display, range(40), 100.0)
    first, second = (submit(rig, FrameSequence((TactileFrame("f", 0.0, 1.0, page_m),))) for _ in range(2))
    finish(rig, second)
    for record in (first, second):
        assert record.status == "done", record.error
        assert record.execution.width_s[-1] == 0.0
        assert record.delay_s == pytest.approx(0.0, abs=2e-6)
        assert abs(record.timing_error.max_abs_s) <= 2e-6
    assert second.first_light_after_s is None
