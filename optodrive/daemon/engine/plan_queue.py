"""Queue of running and waiting plans, and the heat and budget after them.

Theory of operation

Problem. A plan is computed by another thread, from a heat and a budget that lie in the future: those after all plans
accepted so far. Until it is accepted that future may change: a plan ends late, fails, is cancelled or replaced, the
board restarts, the light is paused. A plan from a wrong past must never reach the board: its pulses would be too
strong.

Invariants. `thermal.estimate` is the state after everything that runs or waits, and is replaced by a new object
whenever it changes. A snapshot holds that object; `commit` accepts a plan only if it is still the same one, so one
comparison finds every change, and the planner plans again otherwise. An estimate may be too warm (a plan that was cut
short), never too cold: heat is taken back only by recomputing it from executed pulses (`rewind`), also for the plans
that wait. Plans run in the order of acceptance. What has left for the board is never withdrawn, except by turning the
gate off (`flush`), which ends all running plans. Every pulse is counted exactly once: as executed, dropped, or left in
the plan that waits for its rest.

Lateness. A plan may start later than it was planned for, because the heat that it relied on can only have decayed; all
plans behind it are then delayed by as much (`delay_all`). It may not start so much later that a bump comes out lower
than `cooling_max_m` allows, and behind a cancelled one it is planned again. Several boards emit nothing late, so such a
plan is paused and limited again instead.

What streams add stands in `queue_stream.py`, what pauses and lost stages add in `queue_pause.py`; `queued_plans.py`
holds the plans and ends them.

Threads. The loop that owns the session calls everything; the planning thread takes snapshots and reads `is_busy` and
`stream.must_preempt`. `lock` guards the estimate and both deques between them.
"""

from concurrent.futures import Executor
from math import inf
from typing import Any

from optodrive.core.errors import StoppedError
from optodrive.daemon.engine.active_plan import ActivePlan, PlanStore, RevokedCallers
from optodrive.daemon.engine.plan_making import PlanningSnapshot
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.queue_pause import START_LEAD_S, QueuePause
from optodrive.daemon.engine.queue_stream import STREAM_RESTART_S, STREAM_START_LEAD_S, QueueStream
from optodrive.daemon.engine.queued_plans import ClockShift, PlanRun, QueuedPlans
from optodrive.daemon.engine.thermal_estimate import SavedThermalState
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.daemon.responses.state import QueuedPlan, QueueReport, RecentPlan
from optodrive.link.protocol.states import UNARMED_STATES
from optodrive.link.service.control import DISARM, STOP
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.board_view import get_fault_hint
from optodrive.planning.display_model import DisplayModel


class PlanQueue(QueuedPlans):
    """Queue of the plans.

    Any thread may call make_snapshot() and read is_busy and stream.must_preempt. Everything else belongs to the loop
    that owns the session.
    pause: keeps plans from starting while the light is paused; stream: lets the newest frame replace others
    """

    def __init__(
        self, display: DisplayModel, session: RemoteSession, plan_store: PlanStore, executor: Executor
    ) -> None:
        super().__init__(display, session, executor)
        self._plan_store = plan_store
        self.pause = QueuePause(self, session)
        self.stream = QueueStream(self, display, session)
        self._revoked_callers = RevokedCallers()

    # --- accepting plans ----------------------------------------------------------------------------------------

    def make_snapshot(self, streamed: bool, planning_time_s: float) -> PlanningSnapshot:
        """Build the snapshot for the next plan.

        A streamed plan truncates the running stream at the first pulse that is still unsent after planning_time_s.
        """
        with self.lock:
            thermal = self.thermal.estimate
            start_s = self._earliest_start_s(streamed, planning_time_s)
            last = self.stream.find_running() if streamed and not self.pause.is_held else None
        snapshot = None if last is None else self.stream.build_cut_snapshot(last, thermal, planning_time_s)
        if snapshot is not None:
            return snapshot
        cycle = self.stream.find_cycle() if streamed else None
        return PlanningSnapshot(thermal, start_s, *thermal.shift_to_plan(start_s), cycle=cycle)

    def _earliest_start_s(self, streamed: bool, planning_time_s: float = 0.0) -> float:
        ready_s, end_s = self._session.board_s() + planning_time_s, self.thermal.end_s
        if streamed:
            return max(end_s + STREAM_RESTART_S, ready_s + STREAM_START_LEAD_S)
        return max(end_s, ready_s) + START_LEAD_S

    def commit(self, plan: ActivePlan, snapshot: PlanningSnapshot, cooling_max_m: float = inf) -> bool:
        """Accept a plan into the queue. Return False if its snapshot is stale, or if the plan is too late.

        A plan is too late if its splice has passed, or if it would start so much later than planned that a pixel's
        displacement meanwhile decreases by more than cooling_max_m, m.
        Raise StoppedError if the epoch of its request has passed, or if the token of its caller was revoked.
        """
        self._session.connection.receive()  # a STOP that has been answered is known from here on
        record = plan.record
        with self.lock:
            self.require_epoch(plan.epoch)
            if record.streamed:
                self.pause.require_no_pause()
            self._revoked_callers.require_valid(record.caller, record.arrived_s)
            # A snapshot is stale if an earlier plan was late or failed, or the board restarted.
            # Identity, not equality: every change makes a new object, so that one comparison finds all.
            if self.thermal.estimate is not snapshot.thermal:
                return False
            record.planned_after_s = self._session.board_s() - record.arrived_s  # link may send at once
            if snapshot.predecessor is None:
                start_s = max(record.start_s, self._earliest_start_s(record.streamed))
                if start_s > record.start_s:
                    # Later is safe for the skin, but a bump from less heat is lower.
                    if snapshot.thermal.compute_cooling_m(record.start_s, start_s) > cooling_max_m:
                        return False
                    plan.begin_from(*snapshot.thermal.shift_to_plan(start_s))
                record.start_s = start_s
                self.waiting.append(plan)
            elif snapshot.cut is None or not self.stream.splice(plan, snapshot.predecessor, snapshot.cut):
                return False
            # Before the lock is released: the next snapshot must contain this plan's heat.
            self.thermal.append(plan)
            self.stream.record_accepted(plan)
            self.accounts.totals["planned"] += record.pulse_count
            record.change_status(PlanStatus.QUEUED if snapshot.predecessor is None else PlanStatus.RUNNING)
            self.stream.follow_withdrawn(plan, snapshot)
            self._plan_store.add(plan)
            if snapshot.predecessor is not None and not record.pulse_count:
                self.end_waiting(plan, PlanStatus.DONE, None)
            return True

    def require_epoch(self, epoch: int) -> None:
        """Raise StoppedError if an epoch has passed. Any thread may call it."""
        if epoch != self._session.epoch:
            raise StoppedError(f"the request was stopped before it was carried out ({self._session.epoch_reason})")

    def revoke(self, caller: str) -> None:
        """End all plans of a caller whose token was revoked, and accept none that was requested before now."""
        reason = self._revoked_callers.revoke(caller, self._session.board_s())
        for plan in [*self.waiting, *(run.plan for run in self.running)]:
            if plan.record.caller == caller:
                self.cancel(plan.record, reason)

    # --- running plans ------------------------------------------------------------------------------------------

    def cancel(self, record: PlanRecord, reason: str = "") -> None:
        """Cancel a plan. Those behind it are planned again, because their pulses are for warmer pixels."""
        super().cancel(record, reason)
        if self.waiting:
            self.pause.begin(self._session.board_s())

    def start_next(self) -> None:
        """Start the next plan if the board is ready for it.

        Several boards emit nothing late: a plan whose time has passed while it waited for them is proven again for now.
        """
        # One job at a time; a stream's next plan is spliced into it, and does not pass here.
        if self.running or not self.waiting or not self._session.is_ready or self.pause.off_s is not None:
            return
        if len(self._session.scales) > 1 and self._find_start_s(self.waiting[0]) < self._session.board_s():
            self.pause.begin(self._session.board_s())
            return
        with self.lock:
            plan = self.waiting.popleft()
            record = plan.record
            if not plan.rest_count:
                self.end_waiting(plan, PlanStatus.DONE, None)
                return
            record.change_status(PlanStatus.RUNNING)
            ahead_s = self.stream.lead_s if record.streamed else inf
            job = self._session.begin(plan.points, self._find_start_s(plan), plan.epoch, ahead_s, plan.crc)
            self.running.append(PlanRun(plan, job))

    @staticmethod
    def _find_start_s(plan: ActivePlan) -> float:
        """Return the board time at which the points of a plan begin, s."""
        return plan.record.start_s + plan.zero_s

    def update_jobs(self, refusal: str | None) -> None:
        """Update the plans from the board's reports. refusal: reason of a refusal since the last update."""
        # First: a board that is not armed executes nothing of what runs.
        if self._session.board.state in UNARMED_STATES and self.is_busy:
            self.end_all(PlanStatus.FAILED, self._describe_unarmed())
        off_s = self._session.pop_drained()
        if off_s is not None:
            self.pause.interrupt(off_s)
        self.pause.end_if_idle()
        for run in self.running:
            self.accounts.count_progress(run)
        # All of them: one report may end several short plans.
        while self.running and self.running[0].job.is_finished:
            self._finish_first()
        if self.running and refusal is not None:
            self._session.flush()
            self.end_running(PlanStatus.FAILED, f"the board refused a part of the plan ({refusal})")

    def _describe_unarmed(self) -> str:
        """Return why the board no longer executes plans, in one sentence."""
        board = self._session.board
        cause = self._session.likely_cause if board.fault == "LINK" else None
        cause_text = get_fault_hint(board.fault) if cause is None else cause.message
        reason = f"{board.fault}: {cause_text}" if board.fault else self._session.last_event_reason
        return f"the board went to {board.state} ({reason})"

    def _finish_first(self) -> None:
        """End the first running plan. A delay of it shifts everything after it."""
        with self.lock:
            run = self.running.popleft()
            record = run.plan.record
            is_partial = record.dropped or run.plan.growth is not None
            self.conclude(run, PlanStatus.SUPERSEDED if is_partial else PlanStatus.DONE, None)
            # A late end delays the heat of all plans behind it.
            self.delay_all(record.delay_s)
            if run.plan.is_cut_short and not self.running:  # a pause has begun, and its last report is here first
                self.thermal.rewind([run.plan], self.waiting)
            self.stream.keep_unfinished(run.plan)

    def end_epoch(self, reason: str, clock_shift_s: float = 0.0) -> None:
        """End all plans of an epoch that has ended.

        reason: what ended it; clock_shift_s: as for end_all
        """
        # What a person has asked for is no failure.
        status = PlanStatus.STOPPED if reason in (STOP, DISARM) else PlanStatus.FAILED
        self.stream.forget_cycle()
        self.end_all(status, reason, clock_shift_s)

    def on_board_restarted(self, delay_s: float) -> None:
        """Shift heat and budget to the restarted clock of the board."""
        self.accounts.events.append(ClockShift(delay_s))
        self.stream.forget_cycle()
        with self.lock:
            self.thermal.shift_clock(delay_s)

    # --- restarts of the planner --------------------------------------------------------------------------------

    def build_saved_state(self, host_s: float) -> SavedThermalState:
        """Return the state from which a successor of this process continues. host_s: present host time."""
        with self.lock:
            return self.thermal.build_saved_state(self.list_active(), host_s)

    @property
    def saved_key(self) -> object:
        """A value that changes whenever build_saved_state() would return another state."""
        return self.thermal.build_saved_key(self.list_active())

    def restore(self, saved: SavedThermalState, host_s: float) -> None:
        """Continue from the state of an earlier planner, whose plans the link process has ended."""
        with self.lock:
            self.thermal.restore(saved, host_s)


def build_queue_report(
    plan_queue: PlanQueue, recent: list[PlanRecord], board_now_s: float, host_now_s: float
) -> QueueReport:
    """Report the running and waiting plans with their progress at a board and host time, s, and the recent ones."""
    running = [run.plan.record for run in plan_queue.running.copy()]
    waiting = [plan.record for plan in plan_queue.waiting.copy()]
    if waiting and waiting[0].status == PlanStatus.PAUSED:
        running.append(waiting.pop(0))
    pause = plan_queue.pause
    times_at_s = board_now_s if pause.off_s is None else pause.off_s  # as if the queue went on now
    return QueueReport(
        waiting=len(waiting),
        running=running[0].plan_id if running else None,
        paused=pause.ends_in_s is not None,
        pause_ends_in_s=pause.ends_in_s,
        active=[_build_queued(record, times_at_s, host_now_s) for record in (*running, *waiting)],
        plans=[RecentPlan.from_object(record, **_name_counts(record, host_now_s)) for record in recent],
    )


def _name_counts(record: PlanRecord, host_now_s: float) -> dict[str, Any]:
    age_s = max(0.0, host_now_s - record.arrived_host_s)
    return {"plan": record.plan_id, "age_s": age_s, "planned": record.pulse_count, "executed": record.executed_count}


def _build_queued(record: PlanRecord, board_now_s: float, host_now_s: float) -> QueuedPlan:
    starts_in_s = record.start_s + record.delay_s - board_now_s
    ends_in_s = None if record.status == PlanStatus.PAUSED else max(0.0, starts_in_s + record.duration_s)
    counts = _name_counts(record, host_now_s)
    return QueuedPlan.from_object(record, **counts, starts_in_s=starts_in_s, ends_in_s=ends_in_s)
