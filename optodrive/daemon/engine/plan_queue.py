"""Queue of running and waiting plans, and the heat and budget after them.

Theory of operation

Problem. A plan is computed by another thread, from a heat and a budget that lie in the future: those after all plans
accepted so far. Until it is accepted that future may change: a plan ends late, fails, is cancelled or replaced, the
board restarts, the light is paused. A plan from a wrong past must never reach the board: its pulses would be too
strong.

Invariants. `_thermal.estimate` is the state after everything that runs or waits, and is replaced by a new object
whenever it changes. A snapshot holds that object; `commit` accepts a plan only if it is still the same one, so one
comparison finds every change, and the planner plans again otherwise. An estimate may be too warm (a plan that was cut
short), never too cold: heat is taken back only by recomputing it from executed pulses (`rewind`). Plans run in the
order of acceptance. What has left for the board is never withdrawn, except by turning the gate off (`flush`), which
ends all running plans. Every pulse is counted exactly once: as executed, dropped, or left in the plan that waits for
its rest.

Lateness. A plan may start later than it was planned for, because the heat that it relied on can only have decayed; all
plans behind it are then delayed by as much (`_delay_all`). It may not start so much later that a bump comes out lower
than `cooling_max_m` allows. Several boards emit nothing late, so such a plan is paused and limited again instead.

Streams. A source that sends frames wants the newest shown, not a queue of the past (decision 16). Points of a streamed
plan leave only `stream_lead_s` before they are due; a newer plan cuts the running one at the first point that has not
left (`build_cut_snapshot`) and is spliced behind it, one job for the board. The lead is longer without real-time
priority, because a stall of the host longer than the lead is an underrun (decision 38). A splice that comes too late is
refused by link, and the plan is made again; after two such plans `truncate_stream` cuts the running one at once, and
the third begins behind it without a deadline.

Pauses. The board drops its queue; what was not executed becomes the rest of the same plan, which waits at the front and
is limited again for the time at which the light returns (decision 37). A stream is dropped, as it shows the present.
The loss of a stage, where the others go on, interrupts as a pause does. Nobody knows what the lost board emitted: what
it was sent for the time before it was dark for certain counts, and is not repeated. What is left is planned anew, also
that of a stream, unless a newer frame waits already (decision 49).

Threads. The loop that owns the session calls everything; the planning thread takes snapshots and reads `is_busy` and
`must_preempt`. `lock` guards the estimate and both deques between them.
"""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from math import inf

import numpy as np

from optodrive.core.errors import StoppedError
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.plan_simulation import simulate_plan
from optodrive.daemon.engine.plan_store import PlanStore
from optodrive.daemon.engine.planning_snapshot import (
    PlanningSnapshot,
    RefreshCycle,
    build_cut_snapshot,
    mark_refreshed,
)
from optodrive.daemon.engine.progress import ClockShift, PlanRun, find_emitted
from optodrive.daemon.engine.pulse_accounts import PulseAccounts
from optodrive.daemon.engine.queue_pause import START_LEAD_S, QueuePause
from optodrive.daemon.engine.queue_thermal import QueueThermal
from optodrive.daemon.engine.revoked_callers import RevokedCallers
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate
from optodrive.daemon.engine.thermal_memory import SavedThermalState
from optodrive.daemon.responses.plan_status import PlanStatus
from optodrive.link.protocol.point_cut import PointCut
from optodrive.link.protocol.states import UNARMED_STATES
from optodrive.link.service.epoch import DISARM, STOP
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.fault_hints import get_fault_hint
from optodrive.link.session.stage_loss import LostStage
from optodrive.planning.display_model import DisplayModel

STREAM_START_LEAD_S = 0.02
SHARED_STREAM_LEAD_S = 0.04
"""Least lead of a stream if the link process has no real-time scheduling."""
MIN_DELAY_S = 1e-5


class PlanQueue:
    """Plans that run on the board or wait for it.

    Any thread may call make_snapshot() and read is_busy and must_preempt. Everything else belongs to the loop that owns
    the session.
    on_progress: called during long computations in the loop's thread
    accounts: what has become of the pulses
    pause: keeps plans from starting while the light is paused
    """

    def __init__(
        self, display: DisplayModel, session: RemoteSession, plan_store: PlanStore, executor: Executor
    ) -> None:
        self.lock = threading.RLock()
        self.on_progress: Callable[[], None] = lambda: None
        self.running: deque[PlanRun] = deque()
        self.waiting: deque[ActivePlan] = deque()
        self.accounts = PulseAccounts(session)
        self._display = display
        self._session = session
        self._plan_store = plan_store
        self._executor = executor
        self._thermal = QueueThermal(display, session, lambda: self.on_progress())
        self.pause = QueuePause(self.lock, self.waiting, self._thermal, session, self.accounts)
        self._refresh_cycle: RefreshCycle | None = None
        self._revoked_callers = RevokedCallers()

    @property
    def is_busy(self) -> bool:
        """Whether a plan runs or waits."""
        return bool(self.running or self.waiting)

    def count_pulses(self) -> int:
        """Count the pulses of all running and waiting plans."""
        running = [run.plan for run in self.running.copy()]
        return sum(plan.record.pulse_count for plan in (*running, *self.waiting.copy()))

    # --- planning snapshots -------------------------------------------------------------------------------------

    def make_snapshot(self, streamed: bool, planning_time_s: float) -> PlanningSnapshot:
        """Build the snapshot for the next plan.

        A streamed plan truncates the running stream at the first pulse that is still unsent after planning_time_s.
        """
        with self.lock:
            thermal = self._thermal.estimate
            start_s = self._earliest_start_s(streamed, planning_time_s)
            last = self._find_running_stream() if streamed and not self.pause.is_held else None
        if last is not None:
            snapshot = self._build_cut_snapshot(last, thermal, planning_time_s)
            if snapshot is not None:
                return snapshot
        cycle = self._refresh_cycle
        refreshed = cycle.refreshed if streamed and cycle is not None and cycle.thermal is thermal else None
        return PlanningSnapshot(thermal, start_s, *thermal.shift_to_plan(start_s), refreshed=refreshed)

    def _find_running_stream(self) -> ActivePlan | None:
        """Return the running streamed plan that a newer one may truncate, None without one."""
        if self.waiting or not self.running:
            return None
        plan = self.running[-1].plan
        return plan if plan.record.streamed and not plan.record.dropped else None

    def _earliest_start_s(self, streamed: bool, planning_time_s: float = 0.0) -> float:
        lead_s = STREAM_START_LEAD_S if streamed else START_LEAD_S
        return max(self._thermal.end_s, self._session.board_s() + planning_time_s) + lead_s

    @property
    def _stream_lead_s(self) -> float:
        """Time for which points of a streamed plan are sent ahead. A longer stall of the host causes an underrun."""
        lead_s = self._display.config.stream_lead_s
        return lead_s if self._session.is_realtime else max(lead_s, SHARED_STREAM_LEAD_S)

    def _build_cut_snapshot(
        self, running: ActivePlan, thermal: ThermalEstimate, planning_time_s: float
    ) -> PlanningSnapshot | None:
        min_start_s = self._session.board_s() + self._stream_lead_s + planning_time_s
        return build_cut_snapshot(running, thermal, min_start_s, self._display.budget, self._session.tick_s)

    # --- accepting plans ----------------------------------------------------------------------------------------

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
            if self._thermal.estimate is not snapshot.thermal:
                return False
            if snapshot.predecessor is None:
                start_s = max(record.start_s, self._earliest_start_s(record.streamed))
                if start_s > record.start_s:
                    if snapshot.thermal.compute_cooling_m(record.start_s, start_s) > cooling_max_m:
                        return False
                    plan.heat_before, plan.budget_before = snapshot.thermal.shift_to_plan(start_s)
                record.start_s = start_s
                self.waiting.append(plan)
            elif snapshot.cut is None or not self._splice(plan, snapshot.predecessor, snapshot.cut):
                return False
            self._thermal.append(plan)
            self.accounts.totals["planned"] += record.pulse_count
            record.change_status(PlanStatus.QUEUED if snapshot.predecessor is None else PlanStatus.RUNNING)
            record.planned_after_s = self._session.board_s() - record.arrived_s
            self._plan_store.add(plan)
            return True

    def require_epoch(self, epoch: int) -> None:
        """Raise StoppedError if an epoch has passed. Any thread may call it."""
        if epoch != self._session.epoch:
            raise StoppedError(f"the request was stopped before it was carried out ({self._session.epoch_reason})")

    def _splice(self, plan: ActivePlan, predecessor: ActivePlan, cut: PointCut) -> bool:
        if not self.running or self.running[-1].plan is not predecessor:
            return False
        zero_s, ahead_s = plan.record.start_s, self._stream_lead_s
        job = self._session.splice(plan.points, cut.kept_points, zero_s, plan.epoch, ahead_s, plan.crc)
        if job is None:
            return False
        predecessor.record.dropped = predecessor.record.pulse_count - cut.row
        self.running.append(PlanRun(plan, job))
        return True

    @property
    def must_preempt(self) -> bool:
        """Whether a newer streamed plan must preempt others first."""
        with self.lock:
            return bool(self.waiting) or any(not run.plan.record.streamed for run in self.running)

    def preempt(self) -> None:
        """Supersede the waiting plans, and end a running plan that is not streamed, for a newer plan."""
        with self.lock:
            if self.waiting:
                self._thermal.set(self._thermal.estimate_before(self.waiting[0]))
            while self.waiting:
                self._supersede(self.waiting.popleft())
            if self.running and not self.running[-1].plan.record.streamed and not self.pause.is_held:
                plan, job = self.running[0]
                plan.record.dropped = plan.record.pulse_count - job.sent_count
                self._session.flush()
                self.end_running(PlanStatus.SUPERSEDED, "replaced by a newer plan")

    def truncate_stream(self) -> None:
        """Truncate the running streamed plan at the first pulse not yet due to be sent.

        The next plan then starts after it, without a splice deadline.
        """
        with self.lock:
            last = self._find_running_stream()
            if last is None:
                return
            snapshot = self._build_cut_snapshot(last, self._thermal.estimate, planning_time_s=0.0)
            if snapshot is None or snapshot.cut is None or not self._session.truncate(snapshot.cut.kept_points):
                return
            last.record.dropped = last.record.pulse_count - snapshot.cut.row
            estimate = ThermalEstimate.from_plan(snapshot.heat, snapshot.budget, snapshot.start_s)
            self._thermal.set(estimate, snapshot.start_s)
            self._refresh_cycle = RefreshCycle(estimate, mark_refreshed(last, snapshot.cut.row))

    def _supersede(self, plan: ActivePlan) -> None:
        plan.record.dropped = plan.rest_count
        self._end_waiting(plan, PlanStatus.SUPERSEDED, "replaced by a newer plan")

    def _end_waiting(self, plan: ActivePlan, status: PlanStatus, error: str | None) -> None:
        plan.update_execution()
        plan.end(status, error)
        if plan.executed is not None:
            self._executor.submit(simulate_plan, plan, status, error)

    def cancel(self, record: PlanRecord, reason: str = "") -> None:
        """Remove a waiting plan, or turn the gate off and end a running plan with its splices. reason: for people."""
        plan = next((plan for plan in self.waiting if plan.record is record), None)
        if plan is not None:
            with self.lock:
                self.waiting.remove(plan)
                if plan.is_interrupted and self.waiting:
                    first, estimate = self.waiting[0], self._thermal.estimate_before(plan)
                    first.heat_before, first.budget_before = estimate.shift_to_plan(first.record.start_s)
                elif plan.is_interrupted:
                    self._thermal.rewind([plan])
            self._end_waiting(plan, PlanStatus.CANCELLED, reason or "removed from the queue")
        elif any(run.plan.record is record for run in self.running):
            self._session.flush()
            self.end_running(PlanStatus.CANCELLED, reason or "cancelled while running")

    def revoke(self, caller: str) -> None:
        """End all plans of a caller whose token was revoked, and accept none that was requested before now."""
        reason = self._revoked_callers.revoke(caller, self._session.board_s())
        for plan in [*self.waiting, *(run.plan for run in self.running)]:
            if plan.record.caller == caller:
                self.cancel(plan.record, reason)

    # --- running plans ------------------------------------------------------------------------------------------

    def start_next(self) -> None:
        """Start the next plan if the board is ready for it.

        Several boards emit nothing late: a plan whose time has passed while it waited for them is proven again for now.
        """
        if self.running or not self.waiting or not self._session.is_ready or self.pause.off_s is not None:
            return
        if len(self._session.scales) > 1 and self._find_start_s(self.waiting[0]) < self._session.board_s():
            self.pause.begin(self._session.board_s())
            return
        with self.lock:
            plan = self.waiting.popleft()
            record = plan.record
            if not plan.rest_count:
                self._end_waiting(plan, PlanStatus.DONE, None)
                return
            record.change_status(PlanStatus.RUNNING)
            ahead_s = self._stream_lead_s if record.streamed else inf
            job = self._session.begin(plan.points, self._find_start_s(plan), plan.epoch, ahead_s, plan.crc)
            self.running.append(PlanRun(plan, job))

    @staticmethod
    def _find_start_s(plan: ActivePlan) -> float:
        """Return the board time at which the points of a plan begin, s."""
        return plan.record.start_s + plan.zero_s

    def update_jobs(self, refusal: str | None) -> None:
        """Update the plans from the board's reports. refusal: reason of a refusal since the last update."""
        if self._session.board.state in UNARMED_STATES and self.is_busy:
            self.end_all(PlanStatus.FAILED, self._describe_unarmed())
        off_s = self._session.pop_drained()
        if off_s is not None:
            self._interrupt(off_s)
        self.pause.end_if_idle()
        for run in self.running:
            self.accounts.count_progress(run)
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
            self._conclude(run, PlanStatus.SUPERSEDED if record.dropped else PlanStatus.DONE, None)
            if record.delay_s > MIN_DELAY_S:
                self._delay_all(record.delay_s)

    def _interrupt(self, off_s: float) -> None:
        """Let the plans that ran at the pause wait for the rest of their pulses. Drop the rest of a stream.

        off_s: board time at which the light went off
        """
        with self.lock:
            self.pause.begin(off_s)
            streams = [run.plan for run in self.running if run.plan.record.streamed]
            while self.running:
                run = self.running.popleft()
                self.accounts.count_progress(run)
                if self._session.lost is not None and self._counts_on(run, self._session.lost.stage):
                    self._interrupt_by_loss(run, self._session.lost, off_s)
                    continue
                plan, record = run.plan, run.plan.record
                left = record.pulse_count - record.executed_count
                if record.streamed or not left:
                    record.dropped = left
                    error = "the light was paused, and a stream shows the present" if left else None
                    self._conclude(run, PlanStatus.SUPERSEDED if left else PlanStatus.DONE, error)
                    continue
                self.accounts.collect_executed(run)
                delay_s = record.delay_s
                plan.interrupt(off_s)
                if delay_s > MIN_DELAY_S:
                    self._delay_all(delay_s)
                self.waiting.appendleft(plan)
            if streams and not self.waiting:
                self._thermal.rewind(streams)

    @staticmethod
    def _counts_on(run: PlanRun, stage: int) -> bool:
        """Return whether a running plan has points for a stage."""
        return len(run.plan.points.stages[stage]) > 0

    def _interrupt_by_loss(self, run: PlanRun, lost: LostStage, off_s: float) -> None:
        """Let the plan that ran last when a stage was lost wait for its rest, unless a newer streamed one waits.

        Its pulses that the lost board may have emitted count as executed. Time in the dark without a pulse is over.
        """
        self.accounts.collect_executed(run)
        emitted = find_emitted(run, lost)
        plan, record = run.plan.reorder(emitted), run.plan.record
        first_row = int(np.count_nonzero(emitted))
        left_s = record.start_s + float(plan.planned.plan.start_s[first_row:].min(initial=inf))
        plan.interrupt(max(off_s, min(left_s, lost.dark_s)), first_row)
        self.accounts.count_executed(plan)
        left = plan.rest_count
        if left and not self.running and not any(each.record.streamed for each in self.waiting):
            self.waiting.appendleft(plan)
            return
        record.dropped = left
        if self.waiting and not self.running:
            first, estimate = self.waiting[0], self._thermal.estimate_before(plan)
            first.heat_before, first.budget_before = estimate.shift_to_plan(first.record.start_s)
        self._end_waiting(
            plan, PlanStatus.SUPERSEDED if left else PlanStatus.DONE, "replaced by a newer plan" if left else None
        )

    def _conclude(self, run: PlanRun, status: PlanStatus, error: str | None) -> None:
        plan, record = run.plan, run.plan.record
        self.accounts.collect_executed(run)
        plan.update_execution()
        if record.timing_error is not None:
            self.accounts.timing.add(record.timing_error)
        if status in (PlanStatus.STOPPED, PlanStatus.FAILED, PlanStatus.CANCELLED):
            plan.end(status, error)
        self._executor.submit(simulate_plan, plan, status, error)

    def _delay_all(self, delay_s: float) -> None:
        with self.lock:
            self._thermal.delay(delay_s)
            for plan in (*(run.plan for run in self.running), *self.waiting):
                plan.record.start_s += delay_s
            for run in self.running:
                run.job.delay(round(delay_s / self._session.tick_s))

    def end_running(self, status: PlanStatus, error: str | None, clock_shift_s: float = 0.0) -> None:
        """End all running plans and record their executed pulses. clock_shift_s: as for end_all."""
        with self.lock:
            ended = list(self.running)
            self.running.clear()
            for run in ended:
                self._conclude(run, status, error)
            delay_s = max((run.plan.record.delay_s for run in ended), default=0.0)
            if delay_s > MIN_DELAY_S:
                self._delay_all(delay_s)
            if ended and not self.waiting:
                self._thermal.rewind([run.plan for run in ended], clock_shift_s)

    def end_epoch(self, reason: str, clock_shift_s: float = 0.0) -> None:
        """End all plans of an epoch that has ended.

        reason: what ended it; clock_shift_s: as for end_all
        """
        status = PlanStatus.STOPPED if reason in (STOP, DISARM) else PlanStatus.FAILED
        self.end_all(status, reason, clock_shift_s)

    def end_all(self, status: PlanStatus, reason: str, clock_shift_s: float = 0.0) -> None:
        """End all running and waiting plans.

        clock_shift_s: by which the board's clock has jumped since they were queued, see on_board_restarted
        """
        with self.lock:
            waiting = list(self.waiting)
            self.waiting.clear()
            if self.running:
                self.end_running(status, reason, clock_shift_s)
            elif waiting:
                self._thermal.rewind(waiting[:1], clock_shift_s)
        for plan in waiting:
            self._end_waiting(plan, status, reason)

    def on_board_restarted(self, delay_s: float) -> None:
        """Shift heat and budget to the restarted clock of the board."""
        self.accounts.events.append(ClockShift(delay_s))
        with self.lock:
            self._thermal.shift_clock(delay_s)

    # --- restarts of the planner --------------------------------------------------------------------------------

    def _list_active(self) -> list[ActivePlan]:
        return [run.plan for run in self.running] or list(self.waiting)[:1]

    def build_saved_state(self, host_s: float) -> SavedThermalState:
        """Return the state from which a successor of this process continues. host_s: present host time."""
        with self.lock:
            return self._thermal.build_saved_state(self._list_active(), host_s)

    @property
    def saved_key(self) -> object:
        """A value that changes whenever build_saved_state() would return another state."""
        return self._thermal.build_saved_key(self._list_active())

    def restore(self, saved: SavedThermalState, host_s: float) -> None:
        """Continue from the state of an earlier planner, whose plans the link process has ended."""
        with self.lock:
            self._thermal.restore(saved, host_s)
