"""A plan that waits or runs as a value of its record, the heat before it, its points and its executed pulses.

Every change makes another value, so that each thread that holds one reads a plan of one moment. `rebase` is the one
way in which a plan goes on at another time, from other heat, or with other rows. `PlanStore` keeps the records.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.plans import BudgetState, ExecutedPulses, concatenate_executed
from optodrive.daemon.engine.plan_record import Execution, LargestTarget, PlanRecord
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.limiter.limiter import shift_state
from optodrive.planning.limiter.rest import delay_rest
from optodrive.planning.pipeline import SequencePlanner
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.planning.pulse_table import PulseTable

RHYTHM_WAIT_MAX_S = 0.02
"""Longest time for which a frame that comes again waits for its beat, so that late ones do not shift it."""
CUT_MIN_S = 1e-5
"""A pulse that is shorter than planned by more than this was cut short."""


@dataclass(frozen=True, eq=False)
class ThermalEstimate:
    """Heat (best estimate) and budget (bound) after all pulses up to a time, in board time or from a plan's zero."""

    heat: ThermalState
    budget: BudgetState

    def shift(self, delay_s: float) -> "ThermalEstimate":
        """Return the estimate with every pulse delay_s later. By −start_s it counts from a plan's zero at start_s."""
        return ThermalEstimate(self.heat.copy_shifted(delay_s), shift_state(self.budget, delay_s))

    def compute_cooling_m(self, from_s: float, to_s: float) -> float:
        """Return the largest decrease of a pixel's displacement between two times, m.

        The heat of an absorber counts as the displacement to which it leads: shortly after a pulse only that decreases.
        """
        before, after = self.heat.state_at(from_s), self.heat.state_at(to_s)
        to_come_m = 0.5 * self.heat.pixels.kappa_m_per_k * (before.absorber_k - after.absorber_k)
        return float(np.max(np.maximum(before.displacement_m - after.displacement_m, to_come_m)))


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

    def find_beat_s(self, first: int, interval_s: float, ready_s: float) -> float:
        """Return the board time at which a frame that comes again begins with its first pixel, in its rhythm so far.

        interval_s: mean interval between frames; ready_s: board time at which it may begin, and does if it is late
        """
        if not np.isfinite(interval_s - self.pulsed_s[first]):  # the second frame, or a pixel that heat held up
            return ready_s
        beats = np.ceil((ready_s - self.pulsed_s[first]) / interval_s)
        wait_s = float(self.pulsed_s[first] + max(1.0, beats) * interval_s - ready_s)
        return ready_s + wait_s if wait_s < min(RHYTHM_WAIT_MAX_S, 0.5 * interval_s) else ready_s


class PlanRows(NamedTuple):
    """Rows of a whole plan, to which nothing is to be added, with the points that are left to be sent.

    crc: CRC-32 of the verified bytes of the points
    """

    planned: PlannedSequence
    points: StagePoints
    crc: int
    summary_json: bytes


@dataclass(frozen=True, eq=False)
class ActivePlan:
    """A plan with its thermal states and points, a megabyte for a frame of 1,500 pixels. Only its record outlives it.

    before: heat and budget before the plan, from its own zero
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
    """

    record: PlanRecord
    planned: PlannedSequence
    points: StagePoints
    before: ThermalEstimate
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

    @property
    def plan_id(self) -> str:
        """Name of the plan, by which its values of different times belong together."""
        return self.record.plan_id

    @property
    def after(self) -> ThermalEstimate:
        """Heat and budget after all rows, in board time."""
        return ThermalEstimate(self.planned.heat, self.planned.budget).shift(self.record.start_s)

    @property
    def points_start_s(self) -> float:
        """Board time at which the points begin."""
        return self.record.start_s + self.zero_s

    @property
    def executed_before(self) -> int:
        """Number of pulses that were executed before the plan was interrupted last."""
        return 0 if self.executed_rows is None else len(self.executed_rows)

    @property
    def is_cut_short(self) -> bool:
        """Whether the gate went off within an executed pulse since the plan was interrupted last."""
        if self.executed is None or self.executed_rows is None:
            return False
        planned_s, is_new = self.planned.plan.width_s[self.executed_rows], self.executed_rows >= self.first_row
        is_cut = (self.executed.width_s > 0.0) & (self.executed.width_s < planned_s - CUT_MIN_S)
        return bool(np.any(is_cut & is_new))

    @property
    def rest_count(self) -> int:
        """Number of rows from first_row on."""
        return len(self.planned.plan) - self.first_row

    @property
    def left_count(self) -> int:
        """Number of rows behind the last executed one. Reports are collected."""
        last = -1 if self.executed_rows is None or not len(self.executed_rows) else int(self.executed_rows[-1])
        return len(self.planned.plan) - max(self.first_row, last + 1)

    @property
    def unplanned_pixels(self) -> IntArray:
        """Pixels of a streamed frame whose pulses are not planned yet."""
        if self.growth is None:
            return np.zeros(0, dtype=np.int64)
        skipped = [pulse.pixel for pulse in self.planned.skipped]
        planned = np.concatenate([self.planned.plan.pixel, np.array(skipped, dtype=np.int64)])
        return np.setdiff1d(np.flatnonzero(self.planned.sequence_target_m), planned)

    def note(self, **fields: Any) -> "ActivePlan":
        """Return the plan with other fields of its record."""
        return replace(self, record=replace(self.record, **fields))

    def become(self, status: PlanStatus) -> "ActivePlan":
        """Return the plan with another status. Raise ValueError if that cannot follow the present one."""
        return replace(self, record=self.record.change_status(status))

    def rebase(
        self, start_s: float, before: ThermalEstimate | None = None, rows: PlanRows | None = None
    ) -> "ActivePlan":
        """Return the plan as it goes on: with its zero at a board time, from other heat, and with other rows.

        before: from the plan's zero, never more heat than it was made for; the heat after it is predicted again, and
        the budget after it stays the bound for what it was made for. None: as before, or as the rows state
        rows: None for the same ones
        """
        plan, record = self, self.record
        changes = {"start_s": start_s, "folded_delay_s": record.folded_delay_s + start_s - record.start_s}
        if rows is not None:
            plan = replace(plan, planned=rows.planned, points=rows.points, crc=rows.crc, growth=None)
            changes |= describe_rows(rows.planned) | {"summary_json": rows.summary_json}
        if before is not None:
            table, heat = plan.planned.plan, before.heat.copy()
            heat.apply_pulses(table.pixel, table.start_s, table.width_s, table.power_w)
            plan = replace(plan, before=before, planned=replace(plan.planned, heat=heat))
        return plan.note(**changes)

    def delay_points(self, delay_s: float) -> "ActivePlan":
        """Return a plan that was made again with its points later: never warmer."""
        if not self.first_row:
            return self.rebase(self.record.start_s + delay_s)
        planned = replace(self.planned, plan=delay_rest(self.planned.plan, self.first_row, delay_s))
        zero_s = self.zero_s + delay_s
        return replace(self, planned=planned, zero_s=zero_s, origin_s=zero_s).note(**describe_rows(planned))

    def add_executed(self, executed: ExecutedPulses, rows: IntArray) -> "ActivePlan":
        """Return the plan with the executed pulses that the board reports since the last interruption."""
        if self.executed is not None and self.executed_rows is not None:
            executed = concatenate_executed(self.executed, executed)
            rows = np.concatenate([self.executed_rows, rows])
        return replace(self, executed=executed, executed_rows=rows)

    def interrupt(self, off_s: float, first_row: int | None = None) -> "ActivePlan":
        """Return the plan with the rows behind the last executed one kept for later. Its reports are collected.

        off_s: board time at which the light went off
        first_row: keep the rows from this one on instead. Those before it count as executed, also one cut short
        """
        executed, rows = self.executed, self.executed_rows
        if executed is None or rows is None:
            raise ValueError(f"plan {self.plan_id} is interrupted before its reports are collected")
        if first_row is None:
            first_row = int(rows[-1]) + 1 if len(rows) else self.first_row
        if first_row:
            executed = replace(executed, complete=len(rows) == first_row)
        # The remaining rows are as late as the executed ones.
        record, delay_s = self.record, max(0.0, self.record.delay_s)
        start_s = record.start_s + delay_s
        return (
            replace(
                self,
                first_row=first_row,
                executed=replace(executed, start_s=executed.start_s - delay_s),
                is_interrupted=True,
                origin_s=max(self.zero_s, off_s - start_s),
            )
            .become(PlanStatus.PAUSED)
            .note(start_s=start_s, delay_s=0.0, folded_delay_s=record.folded_delay_s + delay_s, sent=len(rows))
        )

    def reorder(self, emitted: BoolArray) -> "ActivePlan":
        """Return the plan with some rows [n] before all others, each part in order of time."""
        order = np.argsort(~emitted, kind="stable")
        plan = self.planned.plan
        columns = {item.name: getattr(plan, item.name)[order] for item in fields(plan) if item.name != "headroom_k"}
        planned = replace(self.planned, plan=replace(plan, **columns), predicted_m=self.planned.predicted_m[order])
        rows = None if self.executed_rows is None else np.flatnonzero(np.isin(order, self.executed_rows))
        return replace(self, planned=planned, executed_rows=rows).note(**describe_rows(planned))

    def update_execution(self) -> "ActivePlan":
        """Return the plan with the pulses executed and the displacements simulated so far in its record."""
        if self.executed is None or self.executed_rows is None:
            return self
        largest = self.record.largest_target
        return self.note(execution=Execution.from_pulses(self.executed, self.executed_rows, self.simulated_m, largest))


def describe_rows(planned: PlannedSequence) -> dict[str, Any]:
    """Return the fields of a record that follow from the rows of a plan."""
    return {
        "pulse_count": len(planned.plan),
        "duration_s": planned.duration_s,
        "pulses": PulseTable.from_planned(planned),
        "largest_target": LargestTarget.from_planned(planned),
    }


RECORDS_MAX = 200
BYTES_MAX = 10_000_000
"""Beyond this number of plans, or of bytes of ended ones, the oldest ended plans are dropped."""
RECENT_PLANS = 20


class PlanStore:
    """Newest records of plans by id, thread-safe. Beyond RECORDS_MAX or BYTES_MAX the oldest ended plans are dropped.

    What counts is the size of a record at its plan's end.

    end_callbacks: called with every plan that ends, by any thread; must not block
    """

    def __init__(self) -> None:
        self.end_callbacks: list[Callable[[ActivePlan], None]] = []
        self._lock = threading.Lock()
        self._records: dict[str, PlanRecord] = {}
        self._ended_bytes: dict[str, int] = {}
        self._kept_bytes = 0

    def publish(self, record: PlanRecord) -> None:
        """Keep a record, in place of an earlier one of the same plan."""
        with self._lock:
            # What is known only after the end of a plan must not bring back a record that was dropped.
            if record.plan_id in self._records or not record.has_ended:
                self._records[record.plan_id] = record
                self._make_room()

    def _make_room(self) -> None:
        while len(self._records) > RECORDS_MAX or self._kept_bytes > BYTES_MAX:
            oldest = next(iter(self._records))
            if oldest not in self._ended_bytes:
                break
            del self._records[oldest]
            self._kept_bytes -= self._ended_bytes.pop(oldest)

    def end(self, plan: ActivePlan, status: PlanStatus, error: str | None) -> ActivePlan:
        """Return a plan with its final status, after all have been told."""
        plan = plan.become(status).note(error=error)
        with self._lock:
            self._records[plan.plan_id] = plan.record
            self._ended_bytes[plan.plan_id] = plan.record.nbytes
            self._kept_bytes += plan.record.nbytes
            self._make_room()
        for callback in self.end_callbacks:
            callback(plan)
        return plan

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


def simulate_plan(store: PlanStore, plan: ActivePlan, status: PlanStatus, error: str | None) -> None:
    """Simulate the executed pulses of a plan and then end it, so that an ended plan always has its displacements."""
    try:
        plan = replace(plan, simulated_m=compute_simulated_m(plan)).update_execution()
    finally:
        if plan.record.has_ended:
            store.publish(plan.record)
        else:
            store.end(plan, status, error)


def compute_simulated_m(plan: ActivePlan) -> FloatArray | None:
    """Compute the peak displacements of the executed pulses, [n]. Return None without a report of the board."""
    executed = plan.executed
    if executed is None:
        return None
    columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    return plan.before.heat.copy().apply_pulses(*columns).displacement_m
