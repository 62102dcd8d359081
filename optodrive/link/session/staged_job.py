"""Points of one plan on their way through the boards of all stages, with the boards' reports of their execution."""

from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError, NotReadyError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import ExecutedPulses, PulsePlan
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.quantisation import DUTY_MAX, WireScale
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.session.clock_sync import DRIFT_MAX, ClockFit
from optodrive.link.session.plan_job import PlanJob, PointTiming, find_begin_tick
from optodrive.link.session.session import BoardSession


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
        power_w = np.zeros(len(stage))
        for number, (part, scale) in enumerate(zip(self.parts, scales, strict=True)):
            mine = stage == number
            row[mine], on_tick[mine], on_ticks[mine], duty[mine], late[mine] = part.read_reports(pulse[mine])
            power_w[mine] = scale.to_power_w(duty[mine] / DUTY_MAX)
        done = on_tick >= 0
        return StageReports(row[done], on_tick[done], on_ticks[done], power_w[done], stage[done], late[done])

    def find_begin_tick(self, reported: StageReports, plan: PulsePlan, tick_s: float, zero_s: float) -> IntArray:
        """Return the tick at which each reported pulse of `plan` began, also of those without light, [n].

        zero_s: time of the plan at which the points begin
        """
        planned_tick = self.zero_tick + (plan.start_s[reported.row] - zero_s) / tick_s
        return find_begin_tick(reported.on_tick, reported.on_ticks, reported.late_ticks, planned_tick)

    def list_executed_rows(self) -> IntArray:
        """Return the plan rows reported as executed, in order."""
        rows = [part.list_executed_rows() for part in self.parts]
        return rows[0] if len(rows) == 1 else np.sort(np.concatenate(rows))

    def build_executed(self, plan: PulsePlan, scales: Sequence[WireScale], zero_s: float = 0.0) -> ExecutedPulses:
        """Return the reported pulses of `plan`. They are complete if none is missing from the untruncated part.

        scales: of each stage; zero_s: time of the plan at which the points begin
        """
        reported, tick_s = self.read_reported(0, len(self._row), scales), scales[0].tick_s
        on_tick = self.find_begin_tick(reported, plan, tick_s, zero_s)
        return ExecutedPulses(
            on_tick=on_tick,
            width_ticks=reported.on_ticks,
            pixel=plan.pixel[reported.row],
            power_w=reported.power_w,
            start_s=np.asarray((on_tick - self.zero_tick) * tick_s + zero_s, dtype=np.float64),
            width_s=np.asarray(reported.on_ticks * tick_s, dtype=np.float64),
            stage=reported.stage,
            complete=all(part.is_complete for part in self.parts),
        )


SEND_AHEAD_MAX_S = 0.3
"""Longest time for which points are sent ahead to several boards; meanwhile their clocks drift."""
CLOCK_PATIENCE_S = 3.0
"""Time for which a start waits until the boards' clocks are known well enough, then it is refused."""
CLOCK_SEEK_SHARE = 0.5
"""Clocks are compared more often while one may be further off than this share of what a start permits."""


class HostTime:
    """Conversion between the host's time and that of each board.

    skew_max_s: largest error of a board's clock with which a plan may start; tick_s: duration of a tick of all boards
    get_prefix: returns the prefix of messages about a board
    """

    def __init__(
        self, clock: Clock, tick_s: float, skew_max_s: float, get_prefix: Callable[[BoardSession], str]
    ) -> None:
        self._clock = clock
        self._tick_s = tick_s
        self._skew_max_s = skew_max_s
        self._get_prefix = get_prefix
        self._awaited_s = clock.now_s()

    def are_known(self, sessions: Sequence[BoardSession]) -> bool:
        """Return whether the time of each board is known as exactly as a start needs it."""
        return all(self._find_error_s(session) <= self._skew_max_s for session in sessions)

    @property
    def is_patience_over(self) -> bool:
        """Whether boards that are ready have waited so long for their clocks that a start is refused."""
        return self._waited_s > CLOCK_PATIENCE_S

    @property
    def _waited_s(self) -> float:
        return self._clock.now_s() - self._awaited_s

    def _find_error_s(self, session: BoardSession) -> float:
        fit = session.clock_sync.fit(self._clock.now_s())
        return inf if fit is None else fit.uncertainty_s

    def seek(self, sessions: Sequence[BoardSession], are_ready: bool) -> None:
        """Compare the clocks more often while they are not known well enough for the start of a plan.

        are_ready: whether the boards wait for nothing else
        """
        for session in sessions:
            # Before the limit is reached: one narrow exchange takes many tries on a busy computer.
            session.seeks_clock = self._find_error_s(session) > CLOCK_SEEK_SHARE * self._skew_max_s
        # The wait counts only while the clocks are all that is missing.
        if not are_ready or self.are_known(sessions):
            self._awaited_s = self._clock.now_s()

    def require_known(self, sessions: Sequence[BoardSession]) -> None:
        """Raise NotReadyError if the time of a board is not known as exactly as a start needs it."""
        for session in sessions:
            fit = self._fit(session)
            if fit.uncertainty_s > self._skew_max_s:
                raise NotReadyError(
                    f"{self._get_prefix(session)}after {self._waited_s:.1f} s of repeated exchanges its clock "
                    f"is known to {1e6 * fit.uncertainty_s:.0f} µs, "
                    f"limits.stage_skew_max_s permits {1e6 * self._skew_max_s:.0f} µs"
                )
            # Points are shifted by at most that rate (`RETIMING_RATE_MAX`): a faster drift would be followed too
            # slowly.
            if abs(fit.rate - 1.0) > DRIFT_MAX:
                raise NotReadyError(
                    f"{self._get_prefix(session)}its clock drifts by {1e6 * (fit.rate - 1.0):+.0f} ppm, "
                    f"at most {1e6 * DRIFT_MAX:.0f} ppm can be followed"
                )

    def _fit(self, session: BoardSession) -> ClockFit:
        fit = session.clock_sync.fit(self._clock.now_s())
        if fit is None:
            raise LinkError(f"{self._get_prefix(session)}its clock is not known")
        return fit

    def build_timing(self, session: BoardSession, zero_tick: int) -> PointTiming:
        """Return the timing of points whose zero is a tick of the host's time."""
        # A function and no number: each point is converted when it leaves, by what is known of the clock then.
        return PointTiming(zero_tick, partial(self._to_board_tick, session))

    def _to_board_tick(self, session: BoardSession, host_tick: int) -> float:
        return self._fit(session).to_board_s(host_tick * self._tick_s) / self._tick_s

    def convert_report(self, session: BoardSession, message: m.Executed) -> m.Executed:
        """Return a board's report with the host's time in place of its own."""
        fit = self._fit(session)
        records = tuple(
            (round(fit.to_host_s(tick * self._tick_s) / self._tick_s), ticks, duty)
            for tick, ticks, duty in message.records
        )
        return m.Executed(message.first_index, records)

    def find_first_sent_tick(self, job: StagedJob, sessions: Sequence[BoardSession]) -> float | None:
        """Return the tick of the host's time at which the first point of a job was sent, None before."""
        now_s = self._clock.now_s()
        fits = [session.clock_sync.fit(now_s) for session in sessions]
        pairs = ((fit, part.first_sent_tick) for fit, part in zip(fits, job.parts, strict=True))
        sent_s = [fit.to_host_s(tick * self._tick_s) for fit, tick in pairs if fit is not None and tick is not None]
        return min(sent_s) / self._tick_s if sent_s else None
