"""Points of one plan on their way through the boards of all stages, with the boards' reports of their execution."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import ExecutedPulses, PulsePlan
from optodrive.link.protocol.quantisation import DUTY_MAX, WireScale
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.session.plan_job import PlanJob, find_begin_tick


class StageReports(NamedTuple):
    """Executed pulses of all stages, all [n]: plan row, tick of gate on, gate-on time in ticks, power and stage.

    on_tick, late_ticks: as in `ReportedPulses`
    """

    row: IntArray
    on_tick: IntArray
    on_ticks: IntArray
    power_w: FloatArray
    stage: IntArray
    late_ticks: IntArray


class StagedJob:
    """Points of one plan on their way through the boards of all stages.

    parts: the job of each stage
    zero_tick: tick of the plan's zero, as those of the reports: of the board, or of the host if there are several
    """

    def __init__(self, parts: Sequence[PlanJob], zero_tick: int) -> None:
        self.parts = tuple(parts)
        self.zero_tick = zero_tick
        self._executed_count = 0
        self._merge_rows()

    def _merge_rows(self) -> None:
        """Sort the pulses of all parts by their rows in the plan."""
        rows = [part.pulse_rows for part in self.parts]
        row = np.concatenate(rows)
        order = np.argsort(row)
        self._row = row[order]
        self._stage = np.repeat(np.arange(len(rows)), [len(each) for each in rows])[order]
        self._pulse = np.concatenate([np.arange(len(each)) for each in rows])[order]

    def extend(self, points: StagePoints) -> None:
        """Append points of each stage behind its last one, with rows of the same plan, as `PlanJob.extend`."""
        for part, one in zip(self.parts, points.stages, strict=True):
            part.extend(one)
        self._merge_rows()

    def delay(self, ticks: int) -> None:
        """Shift the plan's zero because an earlier job was late."""
        self.zero_tick += ticks
        for part in self.parts:
            part.delay(ticks)

    def truncate(self, kept_points: Sequence[int]) -> bool:
        """Truncate each part to its number of points. Return False, unchanged, if one has sent more."""
        pairs = list(zip(self.parts, kept_points, strict=True))
        return all(part.can_truncate(kept) for part, kept in pairs) and all(one.truncate(kept) for one, kept in pairs)

    @property
    def first_sent_tick(self) -> float | None:
        """Tick at which the first point of all was sent, None before."""
        return min((part.first_sent_tick for part in self.parts if part.first_sent_tick is not None), default=None)

    @property
    def is_finished(self) -> bool:
        """Whether every point was sent and reported as executed."""
        return all(part.is_finished for part in self.parts)

    @property
    def pulse_count(self) -> int:
        """Number of pulses among the points."""
        return len(self._row)

    @property
    def sent_count(self) -> int:
        """Number of pulses sent so far."""
        return sum(part.sent_count for part in self.parts)

    @property
    def executed_count(self) -> int:
        """Number of pulses reported as executed, without a gap from the plan's first."""
        if len(self.parts) == 1:
            return self.parts[0].executed_count
        reported = np.array([part.executed_count for part in self.parts])
        missing = np.flatnonzero(self._pulse[self._executed_count :] >= reported[self._stage[self._executed_count :]])
        self._executed_count = self._executed_count + int(missing[0]) if len(missing) else len(self._row)
        return self._executed_count

    def read_reported(self, begin: int, end: int, scales: Sequence[WireScale]) -> StageReports:
        """Return the reports so far of pulses begin to end, in order of the plan. Any thread may call it.

        scales: of each stage
        """
        stage, pulse = self._stage[begin:end], self._pulse[begin:end]
        row, on_tick, on_ticks, duty, late = (np.zeros(len(stage), dtype=np.int64) for _ in range(5))
        full_power_w = np.zeros(len(stage))
        for number, (part, scale) in enumerate(zip(self.parts, scales, strict=True)):
            mine = stage == number
            row[mine], on_tick[mine], on_ticks[mine], duty[mine], late[mine] = part.read_reports(pulse[mine])
            full_power_w[mine] = scale.full_power_w
        done = on_tick >= 0
        power_w = np.asarray(duty / DUTY_MAX * full_power_w, dtype=np.float64)
        return StageReports(row[done], on_tick[done], on_ticks[done], power_w[done], stage[done], late[done])

    def find_begin_tick(self, reported: StageReports, plan: PulsePlan, tick_s: float) -> IntArray:
        """Return the tick at which each reported pulse of `plan` began, also of those without light, [n]."""
        planned_tick = self.zero_tick + plan.start_s[reported.row] / tick_s
        return find_begin_tick(reported.on_tick, reported.on_ticks, reported.late_ticks, planned_tick)

    def list_executed_rows(self) -> IntArray:
        """Return the plan rows reported as executed, in order."""
        rows = [part.list_executed_rows() for part in self.parts]
        return rows[0] if len(rows) == 1 else np.sort(np.concatenate(rows))

    def build_executed(self, plan: PulsePlan, scales: Sequence[WireScale]) -> ExecutedPulses:
        """Return the reported pulses of `plan`. They are complete if none is missing from the untruncated part.

        scales: of each stage
        """
        reported, tick_s = self.read_reported(0, len(self._row), scales), scales[0].tick_s
        on_tick = self.find_begin_tick(reported, plan, tick_s)
        return ExecutedPulses(
            on_tick=on_tick,
            width_ticks=reported.on_ticks,
            pixel=plan.pixel[reported.row],
            power_w=reported.power_w,
            start_s=np.asarray((on_tick - self.zero_tick) * tick_s, dtype=np.float64),
            width_s=np.asarray(reported.on_ticks * tick_s, dtype=np.float64),
            stage=reported.stage,
            complete=all(part.is_complete for part in self.parts),
        )
