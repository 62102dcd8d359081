"""Records of submitted plans, from queued to done, superseded, stopped, failed or cancelled."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from optodrive.core.quantity import m_to_um
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import ExecutedPulses
from optodrive.daemon.responses.plan import ExecutedColumns, MaxTarget, PlanLatency, PlanOnset, PlanReport, PlanStatus
from optodrive.link.session.clock_sync import ClockReading, TimingError
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.planning.pulse_table import PULSES_LISTED_MAX, Int32Array, PulseTable, UInt8Array
from optodrive.planning.summary_schema import PlanSummary


class LargestTarget(NamedTuple):
    """The pulse of a plan with the largest target."""

    row: int
    pixel: int
    target_m: float
    predicted_m: float

    @classmethod
    def from_planned(cls, planned: PlannedSequence) -> Self | None:
        """Return the pulse with the largest target, or None if no pulse has a target."""
        plan = planned.plan
        target_m = np.nan_to_num(plan.target_m)
        if not len(plan) or not target_m.any():
            return None
        row = int(target_m.argmax())
        return cls(row, int(plan.pixel[row]), float(target_m[row]), float(planned.predicted_m[row]))


@dataclass(frozen=True, eq=False)
class Execution:
    """Pulses of a plan that the board executed.

    start_s, width_s, power_w, pixel, stage, simulated_m: [n] columns as in `ExecutedPulses`, and displacements computed
    from them; all empty if n exceeds PULSES_LISTED_MAX; simulated_m is None until the simulation is done
    complete: whether no report is missing; is_listed: whether the columns are complete
    simulated_max_m, simulated_target_m: largest displacement, and that of the plan's largest target
    """

    start_s: FloatArray
    width_s: FloatArray
    power_w: FloatArray
    pixel: Int32Array
    stage: UInt8Array
    complete: bool
    is_listed: bool
    simulated_m: FloatArray | None = None
    simulated_max_m: float | None = None
    simulated_target_m: float | None = None

    @classmethod
    def from_pulses(
        cls,
        executed: ExecutedPulses,
        rows: IntArray,
        simulated_m: FloatArray | None = None,
        largest: LargestTarget | None = None,
    ) -> Self:
        """Build it from executed pulses [n], their rows in the plan [n], and their displacements [n]."""
        is_listed = len(executed) <= PULSES_LISTED_MAX
        kept = slice(None) if is_listed else slice(0)
        max_m = target_m = None
        if simulated_m is not None and len(simulated_m):
            max_m = float(simulated_m.max())
            of_target = [] if largest is None else simulated_m[rows == largest.row]
            target_m = float(of_target[0]) if len(of_target) else None
        return cls(
            start_s=executed.start_s[kept].copy(),
            width_s=executed.width_s[kept].copy(),
            power_w=executed.power_w[kept].copy(),
            pixel=executed.pixel[kept].astype(np.int32),
            stage=executed.stage[kept].astype(np.uint8),
            complete=executed.complete,
            is_listed=is_listed,
            simulated_m=None if simulated_m is None else simulated_m[kept].copy(),
            simulated_max_m=max_m,
            simulated_target_m=target_m,
        )

    @cached_property
    def nbytes(self) -> int:
        """Size of all columns, bytes."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))

    def to_columns(self) -> ExecutedColumns | None:
        """Return the columns in the units of a response, or None if they are too long."""
        if not self.is_listed:
            return None
        return ExecutedColumns(
            start_s=self.start_s.tolist(),
            width_s=self.width_s.tolist(),
            power_w=self.power_w.tolist(),
            pixel=self.pixel.tolist(),
            stage=self.stage.tolist(),
            simulated_um=[] if self.simulated_m is None else m_to_um(self.simulated_m).tolist(),
        )


@dataclass(frozen=True, eq=False)
class PlanRecord:
    """One plan with its progress, at one moment. The last one stays, so it holds only the data that its report states.

    pulse_count, duration_s: of the whole plan; summary_json: encoded `PlanSummary`, which is larger in memory
    pulses: None if there are too many to list
    start_s: board time of the plan's zero; folded_delay_s: by how much it was shifted after it was accepted
    arrived_s, arrived_host_s: time of the request, of board and host; *_after_s: time from the request to an event
    caller: name of the token that submitted it
    labels, parameters: of the caller, and of the pattern
    streamed: whether a newer plan may replace its unsent pulses, which then count as dropped
    refreshes: whether it refreshes a standing page, and nobody waits for its end
    execution: None until execution has ended
    first_pulse_s: first gate on from the plan's zero, None without a pulse; onset: the executed one
    """

    plan_id: str
    name: str
    pulse_count: int
    duration_s: float
    summary_json: bytes
    pulses: PulseTable | None
    largest_target: LargestTarget | None
    start_s: float
    arrived_s: float
    arrived_host_s: float = 0.0
    caller: str = ""
    labels: dict[str, str | int | float | bool] = field(default_factory=dict)
    parameters: dict[str, str | float | bool | None] = field(default_factory=dict)
    streamed: bool = False
    refreshes: bool = False
    status: PlanStatus = PlanStatus.PLANNED
    error: str | None = None
    sent: int = 0
    execution: Execution | None = None
    executed_count: int = 0
    delay_s: float = 0.0
    folded_delay_s: float = 0.0
    timing_error: TimingError | None = None
    dropped: int = 0
    planned_after_s: float | None = None
    first_byte_after_s: float | None = None
    first_light_after_s: float | None = None
    first_pulse_s: float | None = None
    onset: ClockReading | None = None

    def change_status(self, status: PlanStatus) -> Self:
        """Return the record with another status. Raise ValueError if that cannot follow the present one."""
        if not self.status.may_become(status):
            raise ValueError(f"plan {self.plan_id} is {self.status}, and cannot become {status}")
        return replace(self, status=status)

    @property
    def has_ended(self) -> bool:
        """Whether the plan has ended."""
        return self.status.has_ended

    @property
    def nbytes(self) -> int:
        """Size of everything that grows with the plan, bytes."""
        listed_bytes = 0 if self.pulses is None else self.pulses.nbytes
        return len(self.summary_json) + listed_bytes + (0 if self.execution is None else self.execution.nbytes)

    def build_report(self, board_now_s: float, pulses: bool = True, clocks: ClockReading | None = None) -> PlanReport:
        """Report the plan.

        pulses: whether the report lists them one by one; clocks: give the onset of a plan that has not begun
        """
        execution = self.execution
        return PlanReport.from_object(
            self,
            plan=self.plan_id,
            starts_in_s=self.start_s + self.delay_s - board_now_s,
            planned=self.pulse_count,
            executed=self.executed_count,
            latency=PlanLatency(
                planned_s=self.planned_after_s,
                first_byte_s=self.first_byte_after_s,
                first_light_s=self.first_light_after_s,
            ),
            onset=self._report_onset(clocks),
            summary=PlanSummary.model_validate_json(self.summary_json),
            pulses=self.pulses.to_columns() if pulses and self.pulses is not None else None,
            simulated_max_um=None if execution is None else _to_um(execution.simulated_max_m),
            max_target=self._report_max_target(execution),
            executed_pulses=execution.to_columns() if pulses and execution is not None else None,
            executed_complete=None if execution is None else execution.complete,
            delay_s=None if execution is None else self.delay_s + self.folded_delay_s,
        )

    def _report_onset(self, clocks: ClockReading | None) -> PlanOnset | None:
        if self.onset is not None:
            return PlanOnset(**self.onset._asdict(), executed=True)
        if clocks is None or self.first_pulse_s is None or self.has_ended:
            return None
        planned = clocks.convert(self.start_s + self.delay_s + self.first_pulse_s)
        return PlanOnset(**planned._asdict(), executed=False)

    def _report_max_target(self, execution: Execution | None) -> MaxTarget | None:
        largest = self.largest_target
        if largest is None:
            return None
        return MaxTarget(
            pixel=largest.pixel,
            target_um=m_to_um(largest.target_m),
            predicted_um=m_to_um(largest.predicted_m),
            simulated_um=None if execution is None else _to_um(execution.simulated_target_m),
        )


def _to_um(value_m: float | None) -> float | None:
    return None if value_m is None else m_to_um(value_m)
