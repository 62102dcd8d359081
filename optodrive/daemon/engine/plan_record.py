"""Records of submitted plans, from queued to done, superseded, failed or cancelled."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.plans import BudgetState, ExecutedPulses
from optodrive.core.units import m_to_um
from optodrive.daemon.engine.loop_commands import uncancellable_future
from optodrive.daemon.responses.plan import ExecutedColumns, MaxTarget, PlanLatency, PlanReport, PlanStatus
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.link.session.timing_error import TimingError
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.feasibility.report import FeasibilityReport
from optodrive.planning.plan_summary import PULSES_LISTED_MAX, list_pulse_columns, summarize_plan
from optodrive.planning.planned_sequence import PlannedSequence

RECORDS_MAX = 200
PULSES_MAX = 1_000_000
"""Beyond these numbers of plans or pulses the oldest ended plans are dropped."""
RECENT_PLANS = 20


@dataclass
class PlanRecord:
    """One plan with its progress.

    heat_before, budget_before: initial state of the plan, on its own time line
    start_s: board time of the plan's zero
    arrived_s: board time of the request; *_after_s: time from the request to an event
    epoch: in which the request arrived; the board executes nothing of an older one
    crc: CRC-32 of the verified bytes of the points
    caller: name of the token that submitted it
    streamed: whether a newer plan may replace its unsent pulses, which then count as dropped
    executed_rows, simulated_m: [n executed] plan rows, and displacements computed from the board's report
    refreshed: [p] pixels that the stream's refresh cycle had drawn before this plan
    end_future: done when the plan has ended
    on_end: called with the record at its end; must neither block nor raise
    """

    plan_id: str
    name: str
    planned: PlannedSequence
    feasibility: FeasibilityReport | None
    points: WirePoints
    heat_before: ThermalState
    budget_before: BudgetState
    start_s: float
    arrived_s: float
    epoch: int
    crc: int
    caller: str = ""
    streamed: bool = False
    status: PlanStatus = "planned"
    error: str | None = None
    sent: int = 0
    executed: ExecutedPulses | None = None
    executed_rows: IntArray | None = None
    simulated_m: FloatArray | None = None
    executed_count: int = 0
    delay_s: float = 0.0
    timing_error: TimingError | None = None
    dropped: int = 0
    planned_after_s: float | None = None
    first_byte_after_s: float | None = None
    first_light_after_s: float | None = None
    refreshed: BoolArray | None = None
    end_future: "Future[None]" = field(default_factory=uncancellable_future)
    on_end: "Callable[[PlanRecord], None]" = field(default=lambda record: None)

    @property
    def has_ended(self) -> bool:
        """Whether the plan has ended."""
        return self.status in ("done", "superseded", "failed", "cancelled")

    def end(self, status: PlanStatus, error: str | None) -> None:
        """End the plan with a final status."""
        self.status, self.error = status, error
        self.end_future.set_result(None)
        self.on_end(self)

    def build_report(self, board_now_s: float, pulses: bool = True) -> PlanReport:
        """Report the plan; `pulses` lists them one by one."""
        executed, simulated_m = self.executed, self.simulated_m
        return PlanReport(
            plan=self.plan_id,
            name=self.name,
            caller=self.caller,
            status=self.status,
            error=self.error,
            starts_in_s=self.start_s + self.delay_s - board_now_s,
            planned=len(self.planned.plan),
            sent=self.sent,
            executed=self.executed_count,
            dropped=self.dropped,
            latency=PlanLatency(
                planned_s=self.planned_after_s,
                first_byte_s=self.first_byte_after_s,
                first_light_s=self.first_light_after_s,
            ),
            timing_error=self.timing_error,
            summary=summarize_plan(self.planned, self.feasibility),
            pulses=list_pulse_columns(self.planned) if pulses else None,
            simulated_max_um=_max_um(simulated_m) if executed is not None else None,
            max_target=self._report_max_target(),
            executed_pulses=_list_executed(executed, simulated_m) if pulses and executed is not None else None,
            executed_complete=None if executed is None else executed.complete,
            delay_s=None if executed is None else self.delay_s,
        )

    def _report_max_target(self) -> MaxTarget | None:
        """Report the pulse with the largest target; None if no pulse has a target."""
        plan = self.planned.plan
        target_m = np.nan_to_num(plan.target_m)
        if not len(plan) or not target_m.any():
            return None
        row = int(target_m.argmax())
        simulated_um = None
        if self.simulated_m is not None and self.executed_rows is not None and row in self.executed_rows:
            simulated_um = m_to_um(float(self.simulated_m[self.executed_rows == row][0]))
        return MaxTarget(
            pixel=int(plan.pixel[row]),
            target_um=m_to_um(float(target_m[row])),
            predicted_um=m_to_um(float(self.planned.predicted_m[row])),
            simulated_um=simulated_um,
        )


def _max_um(displacement_m: FloatArray | None) -> float | None:
    return None if displacement_m is None or not len(displacement_m) else m_to_um(float(displacement_m.max()))


def _list_executed(executed: ExecutedPulses, simulated_m: FloatArray | None) -> ExecutedColumns | None:
    if len(executed) > PULSES_LISTED_MAX:
        return None
    return ExecutedColumns(
        start_s=executed.start_s.tolist(),
        width_s=executed.width_s.tolist(),
        power_w=executed.power_w.tolist(),
        pixel=executed.pixel.tolist(),
        simulated_um=[] if simulated_m is None else m_to_um(simulated_m).tolist(),
    )


class PlanStore:
    """Records of plans by id, thread-safe. Beyond RECORDS_MAX or PULSES_MAX the oldest ended plans are dropped.

    end_callbacks: called with every plan that ends, by any thread; must not block
    """

    def __init__(self) -> None:
        self.end_callbacks: list[Callable[[PlanRecord], None]] = []
        self._lock = threading.Lock()
        self._records: dict[str, PlanRecord] = {}

    def add(self, record: PlanRecord) -> None:
        """Add a plan."""
        record.on_end = self._run_end_callbacks
        with self._lock:
            self._records[record.plan_id] = record
            pulses = sum(len(kept.planned.plan) for kept in self._records.values())
            for plan_id, oldest in list(self._records.items()):
                if not oldest.has_ended or (len(self._records) <= RECORDS_MAX and pulses <= PULSES_MAX):
                    break
                del self._records[plan_id]
                pulses -= len(oldest.planned.plan)

    def _run_end_callbacks(self, record: PlanRecord) -> None:
        for callback in self.end_callbacks:
            callback(record)

    def find(self, plan_id: str) -> PlanRecord:
        """Return a plan by its id. Raise InputError (plan_not_found) for an unknown plan."""
        with self._lock:
            record = self._records.get(plan_id)
        if record is None:
            raise InputError("plan", plan_id, f"one of the last {RECORDS_MAX} plans", "plan_not_found")
        return record

    def list_recent(self) -> list[PlanRecord]:
        """Return the latest plans, oldest first."""
        with self._lock:
            return list(self._records.values())[-RECENT_PLANS:]
