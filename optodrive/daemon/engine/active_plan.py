"""A plan that waits or runs, with its record, thermal states and points, and the plans that are kept for reports."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError, StoppedError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.plans import BudgetState, ExecutedPulses, concatenate_executed
from optodrive.daemon.engine.plan_record import Execution, LargestTarget, PlanRecord
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.pipeline import SequencePlanner
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.planning.pulse_table import PulseTable

CUT_MIN_S = 1e-5
"""A pulse that is shorter than planned by more than this was cut short."""


class RefreshCycle(NamedTuple):
    """When a stream has drawn each pixel last.

    drawn_s: [p] board time of the start of the last pulse, or of the last frame whose height the heat held, −infinity
    without one; pulsed_s: [p] that of the last pulse alone; width_s: [p] its width, NaN without
    begun_s: the pixels drawn since then have had their turn
    """

    drawn_s: FloatArray
    pulsed_s: FloatArray
    width_s: FloatArray
    begun_s: float

    @property
    def refreshed(self) -> BoolArray:
        """Pixels that have had their turn, [p]."""
        return np.asarray(self.drawn_s >= self.begun_s, dtype=np.bool_)

    def find_order(self, target_m: FloatArray) -> IntArray | None:
        """Return the order in which a frame's pixels were drawn, None if others were drawn since the first of them.

        A frame that comes again in that order gives each pixel the rhythm of the frames.
        """
        active = np.flatnonzero(target_m)
        drawn_s = self.drawn_s[active]
        if not len(active) or np.count_nonzero(self.drawn_s >= drawn_s.min()) != len(active):
            return None
        return np.asarray(active[np.argsort(drawn_s, kind="stable")], dtype=np.int64)


@dataclass(eq=False)
class ActivePlan:
    """A plan with its thermal states and points, a megabyte for a frame of 1,500 pixels. Only its record outlives it.

    heat_before, budget_before: initial state of the plan, on its own time line
    epoch: in which the request arrived; the board executes nothing of an older one
    crc: CRC-32 of the verified bytes of the points
    holds_first: whether its first point waits until it must leave, so that a newer plan can replace it as a whole
    growth: plans the rest once it is due, None for a whole plan
    cycle: refresh cycle of the stream before this plan, None for the first one
    first_row: first row that was not executed when the plan was interrupted last
    initial_pixels: pixel at which the mirrors of each stage point when its points begin; None if one is unknown
    zero_s: time of the plan at which its points begin; origin_s: the same, or when the light went off meanwhile
    is_interrupted: whether the rows from first_row on were dropped, and are not yet planned again
    executed, executed_rows, simulated_m: what the board reports, [n executed] plan rows, and displacements computed
    from it
    on_end: called with the plan at its end; must neither block nor raise
    """

    record: PlanRecord
    planned: PlannedSequence
    points: StagePoints
    heat_before: ThermalState
    budget_before: BudgetState
    epoch: int
    crc: int
    holds_first: bool = False
    growth: SequencePlanner | None = None
    cycle: RefreshCycle | None = None
    first_row: int = 0
    initial_pixels: tuple[int, ...] | None = None
    zero_s: float = 0.0
    origin_s: float = 0.0
    is_interrupted: bool = False
    executed: ExecutedPulses | None = None
    executed_rows: IntArray | None = None
    simulated_m: FloatArray | None = None
    on_end: "Callable[[ActivePlan], None]" = field(default=lambda plan: None)

    @property
    def executed_before(self) -> int:
        """Number of pulses that were executed before the plan was interrupted last."""
        return 0 if self.executed_rows is None else len(self.executed_rows)

    @property
    def is_cut_short(self) -> bool:
        """Whether the gate went off within an executed pulse."""
        if self.executed is None or self.executed_rows is None:
            return False
        planned_s = self.planned.plan.width_s[self.executed_rows]
        return bool(np.any((self.executed.width_s > 0.0) & (self.executed.width_s < planned_s - CUT_MIN_S)))

    @property
    def rest_count(self) -> int:
        """Number of rows from first_row on."""
        return len(self.planned.plan) - self.first_row

    @property
    def unplanned_pixels(self) -> IntArray:
        """Pixels of a streamed frame whose pulses are not planned yet."""
        if self.growth is None:
            return np.zeros(0, dtype=np.int64)
        skipped = [pulse.pixel for pulse in self.planned.skipped]
        planned = np.concatenate([self.planned.plan.pixel, np.array(skipped, dtype=np.int64)])
        return np.setdiff1d(np.flatnonzero(self.planned.sequence_target_m), planned)

    def begin_from(self, heat: ThermalState, budget: BudgetState) -> None:
        """Let a plan that has not begun start from less heat than it was made for: later, or after less light.

        The budget after it stays the bound for what it was made for.
        """
        self.heat_before, self.budget_before = heat, budget
        self.predict_heat()

    def predict_heat(self) -> None:
        """Compute the heat after all rows from the heat before the plan."""
        rows, after = self.planned.plan, self.heat_before.copy()
        after.apply_pulses(rows.pixel, rows.start_s, rows.width_s, rows.power_w)
        self.planned = replace(self.planned, heat=after)

    def replace_rows(self, planned: PlannedSequence, points: StagePoints, crc: int, summary_json: bytes) -> None:
        """Replace all that follows from the rows, by those of a plan to which nothing is to be added."""
        record = self.record
        self.planned, self.points, self.crc, self.growth = planned, points, crc, None
        record.pulse_count, record.duration_s = len(planned.plan), planned.duration_s
        record.pulses, record.largest_target = PulseTable.from_planned(planned), LargestTarget.from_planned(planned)
        record.summary_json = summary_json

    def add_executed(self, executed: ExecutedPulses, rows: IntArray) -> None:
        """Add the executed pulses that the board reports since the last interruption."""
        executed = replace(executed, start_s=executed.start_s + self.zero_s)
        if self.executed is not None and self.executed_rows is not None:
            executed = concatenate_executed(self.executed, executed)
            rows = np.concatenate([self.executed_rows, rows])
        self.executed, self.executed_rows = executed, rows

    def interrupt(self, off_s: float, first_row: int | None = None) -> None:
        """Keep the rows behind the last executed one for later. off_s: board time at which the light went off.

        The rows before it count as executed, also one that was cut short.
        first_row: keep the rows from this one on instead
        """
        if self.executed is None or self.executed_rows is None:
            return
        if first_row is not None:
            self.first_row = first_row
        elif len(self.executed_rows):
            self.first_row = int(self.executed_rows[-1]) + 1
        if self.first_row:
            is_complete = len(self.executed_rows) == self.first_row
            self.executed = replace(self.executed, complete=is_complete)
        self._fold_delay()
        self.is_interrupted = True
        self.origin_s = max(self.zero_s, off_s - self.record.start_s)
        self.record.change_status(PlanStatus.PAUSED)
        self.record.sent = self.executed_before

    def reorder(self, emitted: BoolArray) -> "ActivePlan":
        """Return the plan with some rows [n] before all others, each part in order of time.

        It is another object, because the telemetry may still read this one by its rows.
        """
        order = np.argsort(~emitted, kind="stable")
        plan, record = self.planned.plan, self.record
        columns = {item.name: getattr(plan, item.name)[order] for item in fields(plan) if item.name != "headroom_k"}
        reordered = replace(plan, **columns)
        planned = replace(self.planned, plan=reordered, predicted_m=self.planned.predicted_m[order])
        record.pulses, record.largest_target = PulseTable.from_planned(planned), LargestTarget.from_planned(planned)
        rows = None if self.executed_rows is None else np.flatnonzero(np.isin(order, self.executed_rows))
        return replace(self, planned=planned, executed_rows=rows)

    def _fold_delay(self) -> None:
        """Shift the plan's zero by the delay of the executed pulses, so that the remaining rows are as late."""
        delay_s, self.record.delay_s = max(0.0, self.record.delay_s), 0.0
        self.record.start_s += delay_s
        self.record.folded_delay_s += delay_s
        if self.executed is not None:
            self.executed = replace(self.executed, start_s=self.executed.start_s - delay_s)

    def update_execution(self) -> None:
        """Write the pulses executed and the displacements simulated so far to the record."""
        if self.executed is not None and self.executed_rows is not None:
            self.record.execution = Execution.from_pulses(
                self.executed, self.executed_rows, self.simulated_m, self.record.largest_target
            )

    def end(self, status: PlanStatus, error: str | None) -> None:
        """End the plan with a final status."""
        self.record.change_status(status)
        self.record.error = error
        self.on_end(self)


RECORDS_MAX = 200
BYTES_MAX = 10_000_000
"""Beyond this number of plans, or of bytes of ended ones, the oldest ended plans are dropped."""
RECENT_PLANS = 20


class PlanStore:
    """Records of plans by id, thread-safe. Beyond RECORDS_MAX or BYTES_MAX the oldest ended plans are dropped.

    What counts is the size of a record at its plan's end.

    end_callbacks: called with every plan that ends, by any thread; must not block
    """

    def __init__(self) -> None:
        self.end_callbacks: list[Callable[[ActivePlan], None]] = []
        self._lock = threading.Lock()
        self._records: dict[str, PlanRecord] = {}
        self._ended_bytes: dict[str, int] = {}
        self._kept_bytes = 0

    def add(self, plan: ActivePlan) -> None:
        """Keep the record of a plan."""
        plan.on_end = self._run_end_callbacks
        with self._lock:
            self._records[plan.record.plan_id] = plan.record
            self._make_room()

    def _make_room(self) -> None:
        while len(self._records) > RECORDS_MAX or self._kept_bytes > BYTES_MAX:
            oldest = next(iter(self._records))
            if oldest not in self._ended_bytes:
                break
            del self._records[oldest]
            self._kept_bytes -= self._ended_bytes.pop(oldest)

    def _run_end_callbacks(self, plan: ActivePlan) -> None:
        with self._lock:
            ended_bytes = self._ended_bytes[plan.record.plan_id] = plan.record.nbytes
            self._kept_bytes += ended_bytes
            self._make_room()
        for callback in self.end_callbacks:
            callback(plan)

    def find(self, plan_id: str) -> PlanRecord:
        """Return a plan by its id. Raise InputError (plan_not_found) for an unknown plan."""
        with self._lock:
            record = self._records.get(plan_id)
        if record is None:
            raise InputError(
                "plan", plan_id, "a plan that runs or waits, or one of the latest that ended", "plan_not_found"
            )
        return record

    def list_recent(self) -> list[PlanRecord]:
        """Return the latest plans, oldest first."""
        with self._lock:
            return list(self._records.values())[-RECENT_PLANS:]


class RevokedCallers:
    """Names of callers with the board time of the last revocation, s. A name may belong to a new token since then."""

    def __init__(self) -> None:
        self._revoked_s: dict[str, float] = {}

    def revoke(self, caller: str, board_s: float) -> str:
        """Record a revocation at a board time, s, and return the reason for people."""
        self._revoked_s[caller] = board_s
        return f"the token {caller!r} was revoked"

    def require_valid(self, caller: str, arrived_s: float) -> None:
        """Raise StoppedError for a request that arrived at a board time, s, before the revocation of its token."""
        if arrived_s <= self._revoked_s.get(caller, -inf):
            raise StoppedError(f"the token {caller!r} was revoked")


def simulate_plan(plan: ActivePlan, status: PlanStatus, error: str | None) -> None:
    """Simulate the executed pulses of a plan and then end it, so that an ended plan always has its displacements."""
    try:
        plan.simulated_m = compute_simulated_m(plan)
        plan.update_execution()
    finally:
        if not plan.record.has_ended:
            plan.end(status, error)


def compute_simulated_m(plan: ActivePlan) -> FloatArray | None:
    """Compute the peak displacements of the executed pulses, [n]. Return None without a report of the board."""
    executed = plan.executed
    if executed is None:
        return None
    columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    return plan.heat_before.copy().apply_pulses(*columns).displacement_m
