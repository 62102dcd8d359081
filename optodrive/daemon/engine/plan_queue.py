"""What the board is to do: the plans that run and wait, and the heat and budget after them all.

A plan that is streamed leaves little by little, so that a newer one may take the place of what has not left.
"""

import threading
from collections import deque
from concurrent.futures import Executor
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.plans import BudgetState
from optodrive.daemon.engine.plan_record import PlanRecord, PlanStore
from optodrive.daemon.engine.progress import ClockShift, PlanProgress, PlanRun
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate, apply_executed
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.protocol.states import UNARMED_STATES
from optodrive.link.session.fault_hints import get_fault_hint
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.session import BoardSession
from optodrive.link.session.timing_error import TimingTotals, compute_timing_error
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.limiter import commit_until, shift_state

START_LEAD_S = 0.05
"""A plan starts so long after it is ready and the one before it has ended: its first points must be there in time."""
STREAM_LEAD_S = 0.02
STREAM_SEND_AHEAD_S = 0.04
"""Points of a streamed plan leave so long before they begin; a host that stops for longer makes the board wait."""
MIN_DELAY_S = 1e-5
EVENTS_MAX = 20_000
"""Where nobody takes away what was done: minutes of it. Notes are references, and cost the loop nothing."""


@dataclass(frozen=True, eq=False)
class PlanningSnapshot:
    """From what a plan is made: its zero on the board's clock, heat and budget then, on its own time line.

    thermal: what was known; a plan made from anything else is of no use
    after: the running plan that it cuts short, before row `cut`; standing_on: the pixel the mirrors stand on then
    seen: [p] pixels that a stream's sweep over the display has lit by then
    """

    thermal: ThermalEstimate
    start_s: float
    heat: ThermalState
    budget: BudgetState
    predecessor: PlanRecord | None = None
    cut_row: int = 0
    initial_pixel: int | None = None
    refreshed: BoolArray | None = None


class _RefreshCycle(NamedTuple):
    """How far a sweep over the display had come when a stream was cut: it goes on if nothing came between."""

    thermal: ThermalEstimate
    refreshed: BoolArray


class PlanQueue:
    """Any thread may ask for `basis`, `busy`, `in_the_way`; all else belongs to the loop that owns the session.

    told: what was done, the newest last, for one reader in another thread who takes it away.
    """

    def __init__(self, display: DisplayModel, session: BoardSession, plan_store: PlanStore, executor: Executor) -> None:
        self.lock = threading.RLock()
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
        self._refresh_cycle: _RefreshCycle | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a plan runs or waits."""
        return bool(self.running or self.waiting)

    # --- from what to plan --------------------------------------------------------------------------------------

    def make_snapshot(self, streamed: bool, planning_time_s: float) -> PlanningSnapshot:
        """Where the next plan begins; a streamed one cuts the running one short, allowance_s for planning from now."""
        with self.lock:
            thermal = self._thermal
            start_s = self._earliest_start_s(streamed, planning_time_s if streamed else 0.0)
            last = self._find_running_stream() if streamed else None
        if last is not None:
            snapshot = self._snapshot_at_cut(
                last, thermal, self._session.board_s() + STREAM_SEND_AHEAD_S + planning_time_s
            )
            if snapshot is not None:
                return snapshot
        cycle = self._refresh_cycle
        refreshed = cycle.refreshed if streamed and cycle is not None and cycle.thermal is thermal else None
        return PlanningSnapshot(thermal, start_s, *thermal.shift_to_plan(start_s), refreshed=refreshed)

    def _find_running_stream(self) -> PlanRecord | None:
        """The running plan that a newer one may follow without a pause."""
        if self.waiting or not self.running:
            return None
        record = self.running[-1].record
        return record if record.streamed and not record.dropped else None

    def _earliest_start_s(self, streamed: bool, planning_time_s: float = 0.0) -> float:
        lead_s = STREAM_LEAD_S if streamed else START_LEAD_S
        return max(self._queue_end_s, self._session.board_s() + planning_time_s) + lead_s

    def _snapshot_at_cut(
        self, record: PlanRecord, thermal: ThermalEstimate, min_start_s: float
    ) -> PlanningSnapshot | None:
        """What is known where a running plan is cut before its first pulse after from_s; None where none is left."""
        plan = record.planned.plan
        cut_row = int(np.searchsorted(plan.start_s, min_start_s - record.start_s))
        # The mirrors stand on the last pulse's pixel only if that was lit.
        while 0 < cut_row < len(plan) and plan.power_w[cut_row - 1] == 0.0:
            cut_row += 1
        if not 0 < cut_row < len(plan):
            return None
        end_s = float(plan.start_s[cut_row - 1] + plan.width_s[cut_row - 1])
        heat = record.heat_before.copy()
        heat.apply_pulses(plan.pixel[:cut_row], plan.start_s[:cut_row], plan.width_s[:cut_row], plan.power_w[:cut_row])
        budget = commit_until(plan, float(plan.start_s[cut_row]), record.budget_before, self._display.budget)
        return PlanningSnapshot(
            thermal=thermal,
            start_s=record.start_s + end_s,
            heat=heat.copy_shifted(-end_s),
            budget=shift_state(budget, -end_s),
            predecessor=record,
            cut_row=cut_row,
            initial_pixel=int(plan.pixel[cut_row - 1]),
            refreshed=_mark_refreshed(record, cut_row),
        )

    # --- taking plans on ----------------------------------------------------------------------------------------

    def commit(self, record: PlanRecord, snapshot: PlanningSnapshot) -> bool:
        """Take a plan on; False where what it was made from turned out otherwise meanwhile."""
        with self.lock:
            # A plan before this one came late or failed, the board restarted, or too much has left.
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

    def _splice(self, record: PlanRecord, predecessor: PlanRecord, cut_row: int) -> bool:
        if not self.running or self.running[-1].record is not predecessor:
            return False
        job = self._session.splice(record.points, predecessor.points.count_before(cut_row), STREAM_SEND_AHEAD_S)
        if job is None:
            return False
        predecessor.dropped = len(predecessor.planned.plan) - cut_row
        self.running.append(PlanRun(record, job))
        return True

    @property
    def must_preempt(self) -> bool:
        """Whether a plan that is newer must first have others give way."""
        with self.lock:
            return bool(self.waiting) or any(not run.record.streamed for run in self.running)

    def preempt(self) -> None:
        """Let what waits, and what runs as a whole, give way to a plan that is newer."""
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
                self.end_running("superseded", "a newer plan took its place")

    def truncate_stream(self) -> None:
        """Cut the running streamed plan short by itself: what comes next begins anew after it, and need not hurry."""
        with self.lock:
            last = self._find_running_stream()
            if last is None:
                return
            snapshot = self._snapshot_at_cut(last, self._thermal, self._session.board_s() + STREAM_SEND_AHEAD_S)
            if snapshot is None or not self._session.truncate(last.points.count_before(snapshot.cut_row)):
                return
            last.dropped = len(last.planned.plan) - snapshot.cut_row
            self._thermal = ThermalEstimate.from_plan(snapshot.heat, snapshot.budget, snapshot.start_s)
            self._queue_end_s = snapshot.start_s
            self._refresh_cycle = _RefreshCycle(self._thermal, _mark_refreshed(last, snapshot.cut_row))

    def _supersede(self, record: PlanRecord) -> None:
        record.dropped = len(record.planned.plan)
        record.end("superseded", "a newer plan took its place")

    def cancel(self, record: PlanRecord) -> None:
        """Take a plan out of the queue, or end it dark when it runs, with those that follow it at once."""
        if record in self.waiting:
            with self.lock:
                self.waiting.remove(record)
            record.end("cancelled", "taken out of the queue")
        elif any(run.record is record for run in self.running):
            self._session.flush()
            self.end_running("cancelled", "ended while it ran")

    # --- running them -------------------------------------------------------------------------------------------

    def start_next(self) -> None:
        """Begin the next plan where the board is ready for it."""
        if self.running or not self.waiting or not self._session.is_ready:
            return
        with self.lock:
            record = self.waiting.popleft()
            if not len(record.planned.plan):
                record.end("done", None)
                return
            record.status = "running"
            ahead_s = STREAM_SEND_AHEAD_S if record.streamed else inf
            self.running.append(PlanRun(record, self._session.begin(record.points, record.start_s, ahead_s)))

    def update_jobs(self, refusal: str | None) -> None:
        """Take over what the board did; refusal: what it refused since the last look."""
        board = self._session.board
        if board.state in UNARMED_STATES and self.is_busy:
            cause = self._session.likely_cause if board.fault == "LINK" else None
            cause_text = get_fault_hint(board.fault) if cause is None else cause.message
            reason = f"{board.fault}: {cause_text}" if board.fault else self._session.last_event_reason
            self.fail_all(f"the board went to {board.state} ({reason})")
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
            self.end_running("failed", f"the board refused a part of it ({refusal})")

    def _finish_first(self) -> None:
        """The first running plan is through: a delay moves everything after it."""
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

    def end_running(self, status: PlanStatus, error: str | None) -> None:
        """End everything that runs; what was executed is taken over."""
        with self.lock:
            ended = list(self.running)
            self.running.clear()
            for record, job in ended:
                self._conclude(record, job, status, error)
            delay_s = max((record.delay_s for record, _ in ended), default=0.0)
            if delay_s > MIN_DELAY_S:
                self._delay_all(delay_s)
            if ended and not self.waiting:
                self._rewind_thermal_state([record for record, _ in ended])

    def _rewind_thermal_state(self, ended: list[PlanRecord]) -> None:
        """Nothing after these will run, nor what they have not fired: heat and budget forget both."""
        gate_off_s = self._session.board_s() + self._display.config.board.lease_s
        first = ended[0]
        heat, budget, zero_s = first.heat_before, first.budget_before, first.start_s
        for record in ended:
            plan = record.planned.plan
            heat, budget = heat.copy_shifted(zero_s - record.start_s), shift_state(budget, zero_s - record.start_s)
            zero_s = record.start_s
            kept_pulses = len(plan) - record.dropped
            if kept_pulses:
                until_s = min(gate_off_s - record.start_s, float(np.nextafter(plan.start_s[kept_pulses - 1], inf)))
                budget = commit_until(plan, until_s, budget, self._display.budget)
            if record.executed is not None:
                heat = apply_executed(heat, record.executed)
        self._thermal = ThermalEstimate.from_plan(heat, budget, zero_s)
        self._queue_end_s = max(gate_off_s, self._thermal.budget.at_s)

    def fail_all(self, reason: str) -> None:
        """Nothing that runs or waits will go on."""
        with self.lock:
            waiting = list(self.waiting)
            self.waiting.clear()
            if self.running:
                self.end_running("failed", reason)
            elif waiting:
                self._rewind_thermal_state(waiting[:1])
        for record in waiting:
            record.end("failed", reason)

    def on_board_restarted(self, delay_s: float) -> None:
        """The board's clock was set anew: what is known of heat moves onto it."""
        self.events.append(ClockShift(delay_s))
        with self.lock:
            self._thermal = self._thermal.with_delay(delay_s)
            self._queue_end_s = 0.0


def _mark_refreshed(record: PlanRecord, cut_row: int) -> BoolArray:
    """What a sweep over the display has lit when a plan of it is cut; a sweep that is through begins anew."""
    pixel = record.planned.plan.pixel
    refreshed = (
        np.zeros(len(record.heat_before.pixels), dtype=np.bool_)
        if record.refreshed is None
        else record.refreshed.copy()
    )
    refreshed[pixel[:cut_row]] = True
    return refreshed if not refreshed[pixel[cut_row:]].all() else np.zeros_like(refreshed)


def simulate_record(record: PlanRecord, status: PlanStatus, error: str | None) -> None:
    """Heights of what was executed; a plan is done only then, so that whoever sees it done may read them."""
    try:
        record.simulated_m = compute_simulated_m(record)
    finally:
        if not record.has_ended:
            record.end(status, error)


def compute_simulated_m(record: PlanRecord) -> FloatArray | None:
    """Heights of what was executed, [n]; None where nothing was reported."""
    executed = record.executed
    if executed is None:
        return None
    columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    return record.heat_before.copy().apply_pulses(*columns).displacement_m
