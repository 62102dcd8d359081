"""Queue of plans on its session, which applies the transitions of `QueueState` and sends their consequences.

The loop that owns the session calls everything. Any thread may read `state`, and call make_snapshot() and
require_epoch(): a state is one value, so that no lock is needed.

Streams. A source that sends frames wants the newest shown, not a queue of the past. Points of a streamed
plan leave only `lead_s` before they are due; a newer plan cuts the running one at the first point that has not left
(`build_cut_snapshot`) and goes on behind it, one job for the board. If all points have left it follows them, with a
pause if it comes early, as long as the light of the last one is not about to end. Its first point is held back if yet
another plan is expected before it must leave, and always for a refresh of a standing page: that one then withdraws the
plan as a whole and begins where it would have begun. The lead is longer without real-time priority, because a stall of
the host longer than the lead is an underrun. A cut that comes too late is refused by link, and the plan is made again;
after two such plans `truncate` cuts the running one at once, and the third begins behind it without a deadline.

A plan may grow: its rest is planned when the points behind it must leave, unless a newer plan came (`plan_making.py`).
If that is too late, because the computer stalled, the rest becomes a frame of its own behind it.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from math import inf

from optodrive.core.errors import NotReadyError, StoppedError
from optodrive.daemon.engine.active_plan import ActivePlan, PlanStore, ThermalEstimate, simulate_plan
from optodrive.daemon.engine.metrics import ClockShift, PulseAccounts
from optodrive.daemon.engine.plan_making import ExtendedPlan, PlanningSnapshot, build_cut_snapshot, continue_cycle
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.plan_rest import (
    EndedPlans,
    Restart,
    SavedThermalState,
    restart_plans,
    rewind_estimate,
)
from optodrive.daemon.engine.queue_state import LightEnd, PlanEnd, PlanRun, QueueState
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.protocol.stage_points import PointCut
from optodrive.link.protocol.states import UNARMED_STATES
from optodrive.link.service.control import BEAT_AGE_MAX_S, DISARM, STOP
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.board_view import get_fault_hint
from optodrive.link.session.session import SPLICE_LEAD_S
from optodrive.planning.display_model import DisplayModel

START_LEAD_S = 0.05
"""Minimum time from now, and from the end of the queue, to a plan's zero. Its first points must arrive in time."""
STREAM_START_LEAD_S = 0.02
"""Time from the end of a frame's planning to its light if the beam is free."""
STREAM_RESTART_S = 0.01
"""Time from the end of a job to the light of the next one, so that the board's report and START pass meanwhile."""
SHARED_STREAM_LEAD_S = 0.04
"""Least lead of a stream if the link process has no real-time scheduling."""
APPEND_LEAD_S = SPLICE_LEAD_S + 0.002
"""Least time between a plan and the end of the light that it follows if all of that has left."""
COOLING_MAX_M = 2e-7
"""A plan during whose delay a pixel's displacement decreases by more than this is planned anew, for the heat then."""
GROWTH_MARGIN_S = 0.01
"""Time reserved for the loop and the hand-over of a plan's rest, besides its planning."""
HOLD_MAX_S = 1.0
"""Longest time for which the board waits for points before it ends a plan."""
INTERRUPTED = (PlanStatus.STOPPED, PlanStatus.FAILED, PlanStatus.CANCELLED)
"""Ends that are told at once; others are when the executed pulses have been simulated."""


class PlanQueue:
    """Queue of the plans.

    state: at this moment; on_progress: called during long computations in the loop's thread
    accounts: what has become of the pulses
    """

    def __init__(
        self, display: DisplayModel, session: RemoteSession, plan_store: PlanStore, executor: Executor
    ) -> None:
        self.on_progress: Callable[[], None] = lambda: None
        cold = ThermalEstimate(*display.build_cold_state())
        self.state = QueueState(display.budget, lambda: self.on_progress(), cold)
        self.accounts = PulseAccounts(session)
        self._config, self._budget = display.config, display.budget
        self._session = session
        self._plan_store = plan_store
        self._executor = executor
        self._revoked_s: dict[str, float] = {}

    @property
    def is_busy(self) -> bool:
        """Whether a plan runs or waits."""
        return self.state.is_busy

    def count_pulses(self) -> int:
        """Count the pulses of all running and waiting plans."""
        return sum(plan.record.pulse_count for plan in self.state.plans)

    # --- transitions --------------------------------------------------------------------------------------------

    def _apply(self, state: QueueState) -> None:
        """Take over a state, count, delay jobs, publish records, and end plans."""
        if state is self.state:
            return
        before = {plan.plan_id: plan.record for plan in self.state.plans}
        # First, so that what ends a plan, and any reader in another thread, finds the queue without it.
        self.state = replace(state, ended=())
        for plan in (*(end.plan for end in state.ended), *state.plans):
            known = before.get(plan.plan_id)
            if plan.record is not known:
                self.accounts.count(known, plan.record)
                self._plan_store.publish(plan.record)
        for plan, job in state.running:
            # Link streams by the zero of the job, which follows that of its plan.
            delay_s = plan.record.start_s - before.get(plan.plan_id, plan.record).start_s
            if delay_s:
                job.delay(round(delay_s / self._session.tick_s))
        for end in state.ended:
            self._conclude(end)

    def _conclude(self, end: PlanEnd) -> None:
        """End a plan that left the queue, now or after the simulation of its executed pulses."""
        plan = end.plan.update_execution()
        if plan.record.timing_error is not None:
            self.accounts.timing.add(plan.record.timing_error)
        self._plan_store.publish(plan.record)
        if plan.executed is None or end.status in INTERRUPTED:
            plan = self._plan_store.end(plan, end.status, end.error)
        if plan.executed is not None:
            self._executor.submit(simulate_plan, self._plan_store, plan, end.status, end.error)

    def _collect(self) -> QueueState:
        """Return the state with the executed pulses of all running plans, before a transition that ends them all."""
        return self.state.update_runs([self.accounts.collect_executed(run) for run in self.state.running])

    def _find_light_end(self, clock_shift_s: float = 0.0, notice_s: float = 0.0) -> LightEnd:
        """Return when light is off that is turned off now.

        clock_shift_s: by which the board's clock has jumped since the plans were queued
        notice_s: time until the link process renews the lease no more
        """
        now_s = self._session.board_s() - clock_shift_s
        dark_s = now_s + self._session.round_trip_s  # the command that turns the gate off is on its way
        return LightEnd(dark_s, max(now_s + notice_s + self._config.lease_s, self._session.dark_s))

    # --- accepting plans ----------------------------------------------------------------------------------------

    def make_snapshot(self, streamed: bool, planning_time_s: float) -> PlanningSnapshot:
        """Build the snapshot for the next plan. Any thread may call it.

        A streamed plan truncates the running stream at the first pulse that is still unsent after planning_time_s.
        """
        state = self.state
        start_s = self._earliest_start_s(state, streamed, planning_time_s)
        last = state.replaceable if streamed and not self.is_held else None
        snapshot = None if last is None else self._build_cut_snapshot(last, state.thermal, planning_time_s)
        if snapshot is not None:
            return snapshot
        newest, cycle = state.newest, None
        if streamed and newest is not None:
            cycle = continue_cycle(newest, newest.record.pulse_count - newest.record.dropped)
        return PlanningSnapshot(state.thermal, start_s, state.thermal.shift(-start_s), cycle=cycle)

    def _earliest_start_s(self, state: QueueState, streamed: bool, planning_time_s: float = 0.0) -> float:
        ready_s = self._session.board_s() + planning_time_s
        if streamed:
            return max(state.end_s + STREAM_RESTART_S, ready_s + STREAM_START_LEAD_S)
        return max(state.end_s, ready_s) + START_LEAD_S

    def _build_cut_snapshot(
        self, running: ActivePlan, thermal: ThermalEstimate, planning_time_s: float
    ) -> PlanningSnapshot | None:
        """Build the snapshot of a plan that truncates a running one, None if that is not possible any more."""
        planned_s = self._session.board_s() + planning_time_s
        # Several boards end each job together: nothing follows what has left.
        min_end_s = planned_s + APPEND_LEAD_S if len(self._session.scales) == 1 else inf
        leave_s, begin_s = planned_s + self.lead_s, planned_s + STREAM_START_LEAD_S
        return build_cut_snapshot(running, thermal, leave_s, self._budget, self._session.tick_s, min_end_s, begin_s)

    def commit(self, plan: ActivePlan, snapshot: PlanningSnapshot) -> PlanRecord | None:
        """Accept a plan into the queue, and return its record. Return None if its snapshot is stale, or it is too late.

        A plan is too late if its cut has passed, or if it would start so much later than planned that a pixel's
        displacement meanwhile decreases by more than COOLING_MAX_M.
        Raise StoppedError if the epoch of its request has passed, or if the token of its caller was revoked.
        """
        self._session.connection.receive()  # a STOP that has been answered is known from here on
        record, state = plan.record, self.state
        self.require_epoch(plan.epoch)
        if record.streamed:
            self.require_no_pause()
        self._require_valid(record.caller, record.arrived_s)
        # A snapshot is stale if an earlier plan was late or failed, or the board restarted.
        # Identity, not equality: every change makes a new object, so that one comparison finds all.
        if state.thermal is not snapshot.thermal:
            return None
        plan = plan.note(planned_after_s=self._session.board_s() - record.arrived_s)  # link may send at once
        if snapshot.predecessor is not None:
            replaced = self._replace_from(state, plan, snapshot.predecessor, snapshot.cut)
            if replaced is None:
                return None
            self._apply(replaced)
        else:
            start_s = max(record.start_s, self._earliest_start_s(state, record.streamed))
            if start_s > record.start_s:
                # Later is safe for the skin, but a bump from less heat is lower.
                if snapshot.thermal.compute_cooling_m(record.start_s, start_s) > COOLING_MAX_M:
                    return None
                plan = plan.rebase(start_s, snapshot.thermal.shift(-start_s)).note(folded_delay_s=0.0)
            self._apply(state.accept(plan))
        return self._plan_store.find(plan.plan_id)

    def _replace_from(
        self, state: QueueState, plan: ActivePlan, predecessor: ActivePlan, cut: PointCut | None
    ) -> QueueState | None:
        """Continue the points of a running plan with those of a new one. Return None if the cut has been sent."""
        running = state.running[-1].plan if state.running else None
        # It has ended, or another has replaced a part of it, since the snapshot.
        if cut is None or running is None or running.plan_id != predecessor.plan_id:
            return None
        record = plan.record
        if not record.pulse_count:  # it only ends what was shown: a job without points would be the last one
            is_whole = cut.row == running.record.pulse_count
            done = is_whole or self._session.truncate(cut.kept_points)
            return state.end_behind(cut.row, plan) if done else None
        due_in_s = plan.points_start_s - self.lead_s - self._session.board_s()
        interval_s = record.arrived_s - running.record.arrived_s  # the next one may come after as much
        holds_first = record.refreshes or due_in_s > interval_s
        points, kept_points = plan.points, cut.kept_points
        job = self._session.splice(points, kept_points, record.start_s, plan.epoch, self.lead_s, plan.crc, holds_first)
        if job is None:
            return None
        if record.refreshes and not cut.row:  # its light counts from the fingers that the withdrawn one followed
            plan = plan.note(arrived_s=min(record.arrived_s, running.record.arrived_s))
        return state.replace_from(cut.row, PlanRun(replace(plan, holds_first=holds_first), job))

    def require_epoch(self, epoch: int) -> None:
        """Raise StoppedError if an epoch has passed. Any thread may call it."""
        if epoch != self._session.epoch:
            raise StoppedError(f"the request was stopped before it was carried out ({self._session.epoch_reason})")

    def revoke(self, caller: str) -> None:
        """End all plans of a caller whose token was revoked, and accept none that was requested before now.

        A later request is of a new token with the same name.
        """
        self._revoked_s[caller] = self._session.board_s()
        for plan in self.state.plans:
            if plan.record.caller == caller:
                self.cancel(plan.record, f"the token {caller!r} was revoked")

    def _require_valid(self, caller: str, arrived_s: float) -> None:
        """Raise StoppedError for a request that arrived at a board time before the revocation of its caller's token."""
        if arrived_s <= self._revoked_s.get(caller, -inf):
            raise StoppedError(f"the token {caller!r} was revoked")

    # --- running plans ------------------------------------------------------------------------------------------

    def start_next(self) -> None:
        """Start the next plan if the board is ready for it.

        One whose time has passed meanwhile starts later, or is planned anew if its pixels cool.
        """
        state, now_s = self.state, self._session.board_s()
        # One job at a time; a stream's next plan goes on in the running job, and does not pass here.
        if state.running or not state.waiting or not self._session.is_ready or state.off_s is not None:
            return
        plan = state.waiting[0]
        if plan.points_start_s < now_s:
            delay_s = now_s + START_LEAD_S - plan.points_start_s
            # The heat before a rest is not that before its plan.
            if plan.first_row or plan.before.compute_cooling_m(0.0, delay_s) > COOLING_MAX_M:
                self._apply(state.hold(now_s))
                return
            self._apply(state.delay(delay_s))  # before it has a job, which would be delayed once more
            state, plan = self.state, self.state.waiting[0]
        job = None
        if plan.rest_count:
            ahead_s = self.lead_s if plan.record.streamed else inf
            job = self._session.begin(plan.points, plan.points_start_s, plan.epoch, ahead_s, plan.crc)
        self._apply(state.begin(job))

    def update_jobs(self, refusal: str | None) -> None:
        """Update the plans from the board's reports. refusal: reason of a refusal since the last update."""
        # First: a board that is not armed executes nothing of what runs.
        if self._session.board.state in UNARMED_STATES and self.is_busy:
            self.end_all(PlanStatus.FAILED, self._describe_unarmed())
        drained = self._session.pop_drained()
        if drained is not None:
            self._apply(self._collect().interrupt(*drained, self._session.lost, self._find_light_end()))
        if self.state.off_s is not None and not self.state.waiting and not self.is_held:
            self._apply(self.state.hold(None))
        self._apply(self.state.update_runs([self.accounts.read_progress(run) for run in self.state.running]))
        # All of them: one report may end several short plans.
        while self.state.running and self.state.running[0].job.is_finished:
            first, *others = self.state.running
            state = self.state.update_runs([self.accounts.collect_executed(first), *others])
            self._apply(state.finish(self._find_light_end()))
        if self.state.running and refusal is not None:
            self._session.flush()
            error = f"the board refused a part of the plan ({refusal})"
            self._apply(self._collect().end_running(PlanStatus.FAILED, error, self._find_light_end()))

    def _describe_unarmed(self) -> str:
        """Return why the board no longer executes plans, in one sentence."""
        board = self._session.board
        cause = self._session.likely_cause if board.fault == "LINK" else None
        cause_text = get_fault_hint(board.fault) if cause is None else cause.message
        reason = f"{board.fault}: {cause_text}" if board.fault else self._session.last_event_reason
        return f"the board went to {board.state} ({reason})"

    def cancel(self, record: PlanRecord, reason: str = "") -> None:
        """Remove a waiting plan, or turn the gate off and end all running ones. reason: for people."""
        state = self.state
        if any(run.plan.plan_id == record.plan_id for run in state.running):
            self._session.flush()
            state = self._collect()
        self._apply(state.cancel(record.plan_id, reason, self._find_light_end()))

    def end_all(self, status: PlanStatus, reason: str, clock_shift_s: float = 0.0) -> None:
        """End all running and waiting plans.

        clock_shift_s: by which the board's clock has jumped since they were queued, see on_board_restarted
        """
        self._apply(self._collect().end_all(status, reason, self._find_light_end(clock_shift_s)))

    def end_epoch(self, reason: str, clock_shift_s: float = 0.0) -> None:
        """End all plans of an epoch that has ended.

        reason: what ended it; clock_shift_s: as for end_all
        """
        # What a person has asked for is no failure.
        self.end_all(PlanStatus.STOPPED if reason in (STOP, DISARM) else PlanStatus.FAILED, reason, clock_shift_s)
        self._apply(self.state.forget_stream())

    def on_board_restarted(self, delay_s: float) -> None:
        """Shift heat and budget to the restarted clock of the board."""
        self.accounts.events.append(ClockShift(delay_s))
        self._apply(self.state.shift_clock(delay_s))

    # --- pauses -------------------------------------------------------------------------------------------------

    @property
    def is_held(self) -> bool:
        """Whether the light is paused. Any thread may read it."""
        return self._session.is_held

    @property
    def pause_ends_in_s(self) -> float | None:
        """Time until the pause ends disarmed, s, or None if the light is not paused."""
        return self._session.pause_ends_in_s

    def require_no_pause(self) -> None:
        """Raise NotReadyError while the light is paused. An interruption is over in a moment."""
        self._session.connection.receive()
        if self.is_held and not self._session.is_interrupted:
            raise NotReadyError("the light is paused, and a streamed frame shows the present; resume first")

    @property
    def can_restart(self) -> bool:
        """Whether waiting plans are to be planned anew now. Any thread may read it."""
        state = self.state
        return state.off_s is not None and bool(state.waiting) and not state.running and not self.is_held

    def build_restart(
        self, display: DisplayModel, planning_time_s: float, on_progress: Callable[[], None]
    ) -> Restart | None:
        """Plan the waiting plans anew, in any thread. Return None if none is to be restarted.

        planning_time_s: time that is reserved for this. Raise LocalProtocolError if one exceeds a cap.
        """
        state = self.state
        if not self.can_restart:
            return None
        start_s = self._session.board_s() + START_LEAD_S + planning_time_s
        return restart_plans(display, self._session.scales, state.waiting, start_s, START_LEAD_S, on_progress)

    def commit_restart(self, restart: Restart) -> bool:
        """Let the queue go on. Return False if the queue has changed meanwhile, or it is too late, as for `commit`."""
        self._session.connection.receive()  # a STOP or a pause that has been answered is known from here on
        # A plan is another value after each change of the heat before it.
        if not self.can_restart or self.state.waiting != restart.plans:
            return False
        start_s = restart.start_s
        delay_s = max(0.0, self._session.board_s() + START_LEAD_S - start_s)
        if delay_s and restart.before.compute_cooling_m(start_s, start_s + delay_s) > COOLING_MAX_M:
            return False
        self._apply(self.state.resume(restart, delay_s))
        return True

    # --- streams ------------------------------------------------------------------------------------------------

    @property
    def lead_s(self) -> float:
        """Time for which points of a streamed plan are sent ahead. A longer stall of the host causes an underrun."""
        lead_s = self._config.stream_lead_s
        # A stall longer than the lead is an underrun, and stalls are longer without real-time priority.
        return lead_s if self._session.is_realtime else max(lead_s, SHARED_STREAM_LEAD_S)

    def preempt(self) -> None:
        """Supersede the waiting plans, and end a running plan that is not streamed, for a newer plan."""
        self._apply(self.state.withdraw())
        if self.state.running and not self.state.running[-1].plan.record.streamed and not self.is_held:
            sent = self.state.running[0].job.sent_count
            self._session.flush()
            self._apply(self._collect().preempt(sent, self._find_light_end()))

    def truncate(self) -> None:
        """Truncate the running streamed plan at the first pulse not yet due to be sent.

        The next plan then starts after it, without a deadline.
        """
        state = self.state
        last = state.replaceable
        snapshot = None if last is None else self._build_cut_snapshot(last, state.thermal, planning_time_s=0.0)
        if snapshot is not None and snapshot.cut is not None and self._session.truncate(snapshot.cut.kept_points):
            start_s = snapshot.start_s
            self._apply(state.truncate(snapshot.cut.row, snapshot.before.shift(start_s), start_s))

    def compute_due_in_s(self, planning_time_s: float) -> float:
        """Return the time until the rest of the newest plan must be planned, infinity if it has none.

        planning_time_s: time that this takes
        """
        state = self.state
        plan = state.growing
        if plan is None or state.waiting:
            return inf
        if not state.running:
            return 0.0
        rows = plan.planned.plan
        last_point_s = float(rows.start_s[-2] + rows.width_s[-2]) if len(rows) > 1 else 0.0
        due_s = plan.points_start_s + last_point_s - self.lead_s - planning_time_s - GROWTH_MARGIN_S
        return due_s - self._session.board_s()

    def extend(self, plan: ActivePlan, extended: ExtendedPlan) -> bool:
        """Append the rest of a plan to it. Return False, unchanged, if it is too late or a newer plan came."""
        self._session.connection.receive()
        state = self.state
        growing = state.growing
        if growing is None or not state.is_busy or growing.plan_id != plan.plan_id:
            return False
        if not state.waiting:
            job = state.running[-1].job
            # Link first: if it refuses, nothing here has changed.
            if not self._session.extend(job, extended.added, plan.epoch, extended.added_crc):
                return False
        self._apply(state.extend(extended.rows))
        return True

    def withdraw_rest(self, plan: ActivePlan) -> ActivePlan | None:
        """Withdraw the points of a plan that have not left, before its rest becomes a frame of its own, and return it.

        Return None if a newer plan came.
        """
        growing = self.state.growing
        if growing is None or growing.plan_id != plan.plan_id:
            return None
        if self.state.waiting:
            self.preempt()
            return growing.note(dropped=growing.rest_count)
        self.truncate()
        growing = self.state.newest
        self.give_up_rest()
        return growing

    def give_up_rest(self) -> None:
        """Give up the rest of a plan that has ended without it."""
        self._apply(self.state.give_up_rest())

    # --- restarts of the planner --------------------------------------------------------------------------------

    def build_final_estimate(self) -> ThermalEstimate:
        """Return the estimate after the end of this process, with which the link process ends all plans."""
        return self.state.estimate_end(self._find_light_end(notice_s=BEAT_AGE_MAX_S), HOLD_MAX_S)

    def build_saved_state(self, host_s: float) -> SavedThermalState:
        """Return the state from which a successor of this process continues. host_s: present host time."""
        active = self.state.active
        ended = EndedPlans.from_plans(active) if active else None
        return SavedThermalState(host_s, self._session.board_s(), self.state.thermal, ended)

    @property
    def saved_key(self) -> object:
        """A value that changes whenever build_saved_state() would return another state.

        It leaves out that a plan has ended while the next one runs: the state before both counts the same pulses.
        """
        records = [plan.record for plan in self.state.active[-1:]]
        return self.state.thermal, tuple((record.plan_id, record.dropped, record.start_s) for record in records)

    def restore(self, saved: SavedThermalState, host_s: float) -> None:
        """Continue from the state of an earlier planner, whose plans the link process has ended.

        Every pulse that may have started before now counts, up to the longest time late that the board permits. The
        board's clock may have restarted meanwhile.
        """
        board_s = self._session.board_s()
        expected_s = saved.board_s + host_s - saved.host_s
        estimate = saved.estimate
        if saved.ended is not None:
            gate_off_s = expected_s + self._config.lease_s
            estimate = rewind_estimate(saved.ended, gate_off_s, self._budget, self.on_progress, expected_s)
        self.know(estimate.shift(board_s - expected_s + HOLD_MAX_S))

    def know(self, estimate: ThermalEstimate) -> None:
        """Continue from another estimate, as of an earlier planner or daemon."""
        self._apply(self.state.know(estimate))
