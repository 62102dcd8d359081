"""Queue of running and waiting plans, and the heat and budget after them.

The points of a streamed plan are sent shortly before they are due, so that a newer plan can replace the rest.
"""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from math import inf

from optodrive.core.errors import StoppedError
from optodrive.daemon.engine.plan_record import PlanRecord, PlanStore
from optodrive.daemon.engine.plan_simulation import simulate_record
from optodrive.daemon.engine.planning_snapshot import (
    PlanningSnapshot,
    RefreshCycle,
    build_cut_snapshot,
    mark_refreshed,
)
from optodrive.daemon.engine.progress import ClockShift, PlanProgress, PlanRun
from optodrive.daemon.engine.thermal_estimate import EndedPlan, ThermalEstimate, rewind_estimate
from optodrive.daemon.engine.thermal_memory import SavedThermalState
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.protocol.states import UNARMED_STATES
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.fault_hints import get_fault_hint
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.timing_error import TimingTotals, compute_timing_error
from optodrive.planning.display_model import DisplayModel

START_LEAD_S = 0.05
"""Minimum time from now, and from the end of the queue, to a plan's zero. Its first points must arrive in time."""
STREAM_LEAD_S = 0.02
STREAM_SEND_AHEAD_S = 0.04
"""Time for which points of a streamed plan are sent ahead. A longer stall of the host causes an underrun."""
MIN_DELAY_S = 1e-5
HOLD_MAX_S = 1.0
"""Longest time for which the board waits for points before it ends a plan."""
EVENTS_MAX = 20_000
"""Maximum number of events without a reader, several minutes. Events are references and cost little."""


class PlanQueue:
    """Plans that run on the board or wait for it.

    Any thread may call make_snapshot() and read is_busy and must_preempt. Everything else belongs to the loop that owns
    the session.
    on_progress: called during long computations in the loop's thread
    events: executed pulses and clock shifts, newest last, for one reader in another thread that removes them
    """

    def __init__(
        self, display: DisplayModel, session: RemoteSession, plan_store: PlanStore, executor: Executor
    ) -> None:
        self.lock = threading.RLock()
        self.on_progress: Callable[[], None] = lambda: None
        self.running: deque[PlanRun] = deque()
        self.waiting: deque[PlanRecord] = deque()
        self.totals = {"planned": 0, "sent": 0, "executed": 0}
        self.timing = TimingTotals()
        self.events: deque[PlanProgress | ClockShift] = deque(maxlen=EVENTS_MAX)
        self._display = display
        self._session = session
        self._plan_store = plan_store
        self._executor = executor
        self._thermal = ThermalEstimate(*display.build_cold_state())
        self._queue_end_s = 0.0
        self._refresh_cycle: RefreshCycle | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a plan runs or waits."""
        return bool(self.running or self.waiting)

    def count_pulses(self) -> int:
        """Count the pulses of all running and waiting plans."""
        running = [run.record for run in self.running.copy()]
        return sum(len(record.planned.plan) for record in (*running, *self.waiting.copy()))

    # --- planning snapshots -------------------------------------------------------------------------------------

    def make_snapshot(self, streamed: bool, planning_time_s: float) -> PlanningSnapshot:
        """Build the snapshot for the next plan.

        A streamed plan truncates the running stream at the first pulse that is still unsent after planning_time_s.
        """
        with self.lock:
            thermal = self._thermal
            start_s = self._earliest_start_s(streamed, planning_time_s if streamed else 0.0)
            last = self._find_running_stream() if streamed else None
        if last is not None:
            snapshot = self._build_cut_snapshot(last, thermal, planning_time_s)
            if snapshot is not None:
                return snapshot
        cycle = self._refresh_cycle
        refreshed = cycle.refreshed if streamed and cycle is not None and cycle.thermal is thermal else None
        return PlanningSnapshot(thermal, start_s, *thermal.shift_to_plan(start_s), refreshed=refreshed)

    def _find_running_stream(self) -> PlanRecord | None:
        """Return the running streamed plan that a newer one may truncate, None without one."""
        if self.waiting or not self.running:
            return None
        record = self.running[-1].record
        return record if record.streamed and not record.dropped else None

    def _earliest_start_s(self, streamed: bool, planning_time_s: float = 0.0) -> float:
        lead_s = STREAM_LEAD_S if streamed else START_LEAD_S
        return max(self._queue_end_s, self._session.board_s() + planning_time_s) + lead_s

    def _build_cut_snapshot(
        self, record: PlanRecord, thermal: ThermalEstimate, planning_time_s: float
    ) -> PlanningSnapshot | None:
        min_start_s = self._session.board_s() + STREAM_SEND_AHEAD_S + planning_time_s
        return build_cut_snapshot(record, thermal, min_start_s, self._display.budget)

    # --- accepting plans ----------------------------------------------------------------------------------------

    def commit(self, record: PlanRecord, snapshot: PlanningSnapshot) -> bool:
        """Accept a plan into the queue. Return False if its snapshot is stale or its splice too late.

        Raise StoppedError if the epoch of its request has passed.
        """
        self._session.receive()  # a STOP that has been answered is known from here on
        with self.lock:
            self.require_epoch(record.epoch)
            # A snapshot is stale if an earlier plan was late or failed, or the board restarted.
            if self._thermal is not snapshot.thermal:
                return False
            if snapshot.predecessor is None:
                record.start_s = max(record.start_s, self._earliest_start_s(record.streamed))
                self.waiting.append(record)
            elif not self._splice(record, snapshot.predecessor, snapshot.cut_row):
                return False
            self._thermal = ThermalEstimate.from_plan(record.planned.heat, record.planned.budget, record.start_s)
            self._queue_end_s = record.start_s + record.planned.duration_s
            self.totals["planned"] += len(record.planned.plan)
            record.status = "queued" if snapshot.predecessor is None else "running"
            record.planned_after_s = self._session.board_s() - record.arrived_s
            self._plan_store.add(record)
            return True

    def require_epoch(self, epoch: int) -> None:
        """Raise StoppedError if an epoch has passed. Any thread may call it."""
        if epoch != self._session.epoch:
            raise StoppedError(f"the request was stopped before it was carried out ({self._session.epoch_reason})")

    def _splice(self, record: PlanRecord, predecessor: PlanRecord, cut_row: int) -> bool:
        if not self.running or self.running[-1].record is not predecessor:
            return False
        kept_points = predecessor.points.count_before(cut_row)
        job = self._session.splice(record.points, kept_points, record.epoch, STREAM_SEND_AHEAD_S, record.crc)
        if job is None:
            return False
        predecessor.dropped = len(predecessor.planned.plan) - cut_row
        self.running.append(PlanRun(record, job))
        return True

    @property
    def must_preempt(self) -> bool:
        """Whether a newer streamed plan must preempt others first."""
        with self.lock:
            return bool(self.waiting) or any(not run.record.streamed for run in self.running)

    def preempt(self) -> None:
        """Supersede the waiting plans, and end a running plan that is not streamed, for a newer plan."""
        with self.lock:
            if self.waiting:
                first = self.waiting[0]
                self._thermal = ThermalEstimate.from_plan(first.heat_before, first.budget_before, first.start_s)
                self._queue_end_s = self._thermal.budget.at_s
            while self.waiting:
                self._supersede(self.waiting.popleft())
            if self.running and not self.running[-1].record.streamed:
                record, job = self.running[0]
                record.dropped = len(record.planned.plan) - job.sent_count
                self._session.flush()
                self.end_running("superseded", "replaced by a newer plan")

    def truncate_stream(self) -> None:
        """Truncate the running streamed plan at the first pulse not yet due to be sent.

        The next plan then starts after it, without a splice deadline.
        """
        with self.lock:
            last = self._find_running_stream()
            if last is None:
                return
            snapshot = self._build_cut_snapshot(last, self._thermal, planning_time_s=0.0)
            if snapshot is None or not self._session.truncate(last.points.count_before(snapshot.cut_row)):
                return
            last.dropped = len(last.planned.plan) - snapshot.cut_row
            self._thermal = ThermalEstimate.from_plan(snapshot.heat, snapshot.budget, snapshot.start_s)
            self._queue_end_s = snapshot.start_s
            self._refresh_cycle = RefreshCycle(self._thermal, mark_refreshed(last, snapshot.cut_row))

    def _supersede(self, record: PlanRecord) -> None:
        record.dropped = len(record.planned.plan)
        record.end("superseded", "replaced by a newer plan")

    def cancel(self, record: PlanRecord) -> None:
        """Remove a waiting plan, or turn the gate off and end a running plan with its splices."""
        if record in self.waiting:
            with self.lock:
                self.waiting.remove(record)
            record.end("cancelled", "removed from the queue")
        elif any(run.record is record for run in self.running):
            self._session.flush()
            self.end_running("cancelled", "cancelled while running")

    # --- running plans ------------------------------------------------------------------------------------------

    def start_next(self) -> None:
        """Start the next plan if the board is ready for it."""
        if self.running or not self.waiting or not self._session.is_ready:
            return
        with self.lock:
            record = self.waiting.popleft()
            if not len(record.planned.plan):
                record.end("done", None)
                return
            record.status = "running"
            ahead_s = STREAM_SEND_AHEAD_S if record.streamed else inf
            job = self._session.begin(record.points, record.start_s, record.epoch, ahead_s, record.crc)
            self.running.append(PlanRun(record, job))

    def update_jobs(self, refusal: str | None) -> None:
        """Update the plans from the board's reports. refusal: reason of a refusal since the last update."""
        if self._session.board.state in UNARMED_STATES and self.is_busy:
            self.fail_all(self._describe_unarmed())
        for run in self.running:
            record, job = run
            executed = job.executed_count
            if executed > record.executed_count:
                self.events.append(PlanProgress(run, record.executed_count, executed))
            self.totals["sent"] += job.sent_count - record.sent
            self.totals["executed"] += executed - record.executed_count
            record.sent, record.executed_count = job.sent_count, executed
        while self.running and self.running[0].job.is_finished:
            self._finish_first()
        if self.running and refusal is not None:
            self._session.flush()
            self.end_running("failed", f"the board refused a part of the plan ({refusal})")

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
            record, job = self.running.popleft()
            self._conclude(record, job, "superseded" if record.dropped else "done", None)
            if record.delay_s > MIN_DELAY_S:
                self._delay_all(record.delay_s)

    def _conclude(self, record: PlanRecord, job: PlanJob, status: PlanStatus, error: str | None) -> None:
        scale = self._session.scale
        executed = job.build_executed(record.planned.plan, scale.full_power_w, scale.tick_s)
        record.executed = executed
        if record.executed_count < job.pulse_count:
            self.events.append(PlanProgress(PlanRun(record, job), record.executed_count, job.pulse_count))
        if job.first_sent_tick is not None:
            record.first_byte_after_s = job.first_sent_tick * scale.tick_s - record.arrived_s
        if len(executed):
            record.first_light_after_s = record.start_s + float(executed.start_s[0]) - record.arrived_s
            record.executed_rows = job.list_executed_rows()
            last = int(record.executed_rows[-1])
            record.delay_s = float(executed.start_s[-1] - record.planned.plan.start_s[last])
            record.timing_error = compute_timing_error(
                record.planned.plan.start_s[record.executed_rows], executed.start_s
            )
            if record.timing_error is not None:
                self.timing.add(record.timing_error)
        if status in ("failed", "cancelled"):
            record.end(status, error)
        self._executor.submit(simulate_record, record, status, error)

    def _delay_all(self, delay_s: float) -> None:
        with self.lock:
            self._thermal = self._thermal.with_delay(delay_s)
            self._queue_end_s += delay_s
            for record in (*(run.record for run in self.running), *self.waiting):
                record.start_s += delay_s
            for run in self.running:
                run.job.delay(round(delay_s / self._session.scale.tick_s))

    def end_running(self, status: PlanStatus, error: str | None, clock_shift_s: float = 0.0) -> None:
        """End all running plans and record what they executed. clock_shift_s: as for fail_all."""
        with self.lock:
            ended = list(self.running)
            self.running.clear()
            for record, job in ended:
                self._conclude(record, job, status, error)
            delay_s = max((record.delay_s for record, _ in ended), default=0.0)
            if delay_s > MIN_DELAY_S:
                self._delay_all(delay_s)
            if ended and not self.waiting:
                self._rewind_thermal_state([record for record, _ in ended], clock_shift_s)

    def _rewind_thermal_state(self, ended: list[PlanRecord], clock_shift_s: float) -> None:
        gate_off_s = self._session.board_s() - clock_shift_s + self._display.config.board.lease_s
        plans = [EndedPlan.from_record(record) for record in ended]
        self._thermal = rewind_estimate(plans, gate_off_s, self._display.budget, self.on_progress)
        self._queue_end_s = max(gate_off_s, self._thermal.budget.at_s)

    def fail_all(self, reason: str, clock_shift_s: float = 0.0) -> None:
        """Fail all running and waiting plans.

        clock_shift_s: by which the board's clock has jumped since they were queued, see on_board_restarted
        """
        with self.lock:
            waiting = list(self.waiting)
            self.waiting.clear()
            if self.running:
                self.end_running("failed", reason, clock_shift_s)
            elif waiting:
                self._rewind_thermal_state(waiting[:1], clock_shift_s)
        for record in waiting:
            record.end("failed", reason)

    def on_board_restarted(self, delay_s: float) -> None:
        """Shift heat and budget to the restarted clock of the board."""
        self.events.append(ClockShift(delay_s))
        with self.lock:
            self._thermal = self._thermal.with_delay(delay_s)
            self._queue_end_s = 0.0

    # --- restarts of the planner --------------------------------------------------------------------------------

    def build_saved_state(self, host_s: float) -> SavedThermalState:
        """Return the state from which a successor of this process continues. host_s: present host time."""
        with self.lock:
            records = [run.record for run in self.running] or list(self.waiting)[:1]
            plans = tuple(EndedPlan.from_record(record) for record in records)
            return SavedThermalState(host_s, self._session.board_s(), self._thermal, plans)

    @property
    def saved_key(self) -> object:
        """A value that changes whenever build_saved_state() would return another state."""
        records = [run.record for run in self.running] or list(self.waiting)[:1]
        return id(self._thermal), tuple((record.plan_id, record.dropped, record.start_s) for record in records)

    def restore(self, saved: SavedThermalState, host_s: float) -> None:
        """Continue from the state of an earlier planner, whose plans the link process has ended.

        Every pulse that may have started before now counts, up to the longest time late that the board permits. The
        board's clock may have restarted meanwhile.
        """
        board_s = self._session.board_s()
        expected_s = saved.board_s + host_s - saved.host_s
        gate_off_s = expected_s + self._display.config.board.lease_s
        estimate = saved.estimate
        if saved.plans:
            estimate = rewind_estimate(saved.plans, gate_off_s, self._display.budget, self.on_progress)
        with self.lock:
            self._thermal = estimate.with_delay(board_s - expected_s + HOLD_MAX_S)
            self._queue_end_s = self._thermal.budget.at_s
