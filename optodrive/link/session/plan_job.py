"""Points of one plan on their way through the board, with the board's report of their execution."""

from collections.abc import Callable
from math import ceil, floor, inf
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import ExecutedPulses, PulsePlan
from optodrive.link.protocol.messages import Executed
from optodrive.link.protocol.quantisation import DUTY_MAX, TICKS_MAX, WirePoints, WireScale

RETIMING_RATE_MAX = 2e-4
"""Largest relative shift of points by which a job follows the host's clock, that of two crystals."""
RETIMING_MAX_TICKS = 5
"""Largest shift of one point: that much of its settling time may be missing."""
EARLY_MAX_TICKS = 10
"""By how much a point may seem to begin early, because the start after a late job is rounded."""
LATE_OFF_MAX_TICKS = 100
"""Longest time for which the gate may stay on after a pulse (guard B2)."""


class ReportedPulses(NamedTuple):
    """Executed pulses, all [n]: plan row, tick of gate on, gate-on time in ticks, duty in 1/65535, lateness in ticks.

    on_tick: of a point without light its end, see `find_begin_tick`
    """

    row: IntArray
    on_tick: IntArray
    on_ticks: IntArray
    duty: IntArray
    late_ticks: IntArray


def find_begin_tick(on_tick: IntArray, on_ticks: IntArray, late_ticks: IntArray, planned_tick: FloatArray) -> IntArray:
    """Return the tick at which each reported pulse began, all [n]. planned_tick: at which it should have begun.

    A pulse that was trimmed to nothing is a point without light, which the board reports at its end.
    """
    dark_tick = np.rint(planned_tick).astype(np.int64) + late_ticks
    return np.asarray(np.where(on_ticks == 0, dark_tick, on_tick), dtype=np.int64)


class PointTiming(NamedTuple):
    """Times of a job's points by the host's clock, to which the boards of several stages keep.

    start_tick: at which the points begin, in ticks of the host; to_board_tick: converts a tick of the host as of now
    """

    start_tick: int
    to_board_tick: Callable[[int], float]


class PlanJob:
    """Points of one plan on their way through the board.

    first_index, next_to_send: point indices, which count over the session
    start_tick: board tick of the plan's zero
    send_ahead_ticks: maximum time from sending a point to its start, unless it is the first
    holds_first: whether the first point waits as well, so that the job can be withdrawn until then
    first_sent_tick: board tick at which the first point was sent
    timing: times by the host's clock, which the points follow; None if they keep to the board's own clock
    """

    def __init__(
        self,
        number: int,
        points: WirePoints,
        first_index: int,
        start_tick: int,
        send_ahead_ticks: float = inf,
        timing: PointTiming | None = None,
        holds_first: bool = False,
    ) -> None:
        self.number = number
        self.first_index = first_index
        self.start_tick = start_tick
        self.next_to_send = first_index
        self.first_sent_tick: float | None = None
        self._send_ahead_ticks = send_ahead_ticks
        self._holds_first = holds_first
        # A copy in the board's byte order: retiming changes it, and payloads are slices of it.
        self._table = points.table.astype("<u2")
        self._count = len(points)
        self._timing = timing
        self._planned_end_tick = points.compute_end_ticks()
        # Two columns: the plan's ends stay, these move with drift and delay.
        self._end_tick = start_tick + self._planned_end_tick
        self._delayed_ticks = 0
        self._row = points.row
        self._pulse_points = np.flatnonzero(points.row >= 0)
        self._on_tick = np.full(len(points), -1, dtype=np.int64)
        self._on_ticks = np.zeros(len(points), dtype=np.int64)
        self._duty = np.zeros(len(points), dtype=np.int64)
        self._reported_count = 0

    @property
    def end_index(self) -> int:
        """Index after the last point."""
        return self.first_index + self._count

    def end_tick_after(self, count: int) -> int:
        """Return the scheduled end tick of the first `count` points."""
        return int(self._end_tick[count - 1]) if count else self.start_tick

    @property
    def follows_host(self) -> bool:
        """Whether the points follow the host's clock, as those of several boards."""
        return self._timing is not None

    def find_host_end_tick(self, count: int) -> int:
        """Return the tick of the host at which the first `count` points end. Only for a job with timing."""
        start_tick = 0 if self._timing is None else self._timing.start_tick
        return start_tick + (int(self._planned_end_tick[count - 1]) if count else 0)

    def delay(self, ticks: int) -> None:
        """Shift the plan's zero because an earlier job was late."""
        self.start_tick += ticks
        self._end_tick += ticks
        self._delayed_ticks += ticks

    @property
    def is_fully_sent(self) -> bool:
        """Whether all points were sent."""
        return self.next_to_send == self.end_index

    def count_sendable(self, now_tick: float) -> int:
        """Return the number of points that may be sent now."""
        position = self.next_to_send - self.first_index
        # A plan without a lead leaves as fast as the board has room.
        if self._send_ahead_ticks == inf:
            return self._count - position
        # A point starts at the end of its predecessor. With a float, numpy would convert all ticks at every call.
        due_tick = floor(now_tick + self._send_ahead_ticks)
        # Else the first point leaves at once, and START with it: a plan that has begun cannot be withdrawn.
        if self._holds_first and due_tick < self.start_tick:
            return 0
        due_count = int(np.searchsorted(self._end_tick[: self._count], due_tick, side="right")) + 1
        return max(0, min(due_count, self._count) - position)

    @property
    def next_due_tick(self) -> float | None:
        """Board tick from which the next point may be sent, None if it need not wait."""
        position = self.next_to_send - self.first_index
        waits = position < self._count and (position > 0 or self._holds_first)
        if self._send_ahead_ticks == inf or not waits:
            return None
        return float(self.end_tick_after(position)) - self._send_ahead_ticks

    def take_payload(self, count: int, now_tick: float) -> bytes:
        """Return the bytes of the next points and mark them as sent."""
        if self.first_sent_tick is None:
            self.first_sent_tick = now_tick
        position = self.next_to_send - self.first_index
        if self._timing is not None:
            self._follow_host(self._timing, position)
        self.next_to_send += count
        return self._table[position : position + count].tobytes()

    def _follow_host(self, timing: PointTiming, position: int) -> None:
        """Shift the points from a position on by the drift of the board's clock since the last were sent."""
        off_ticks, on_ticks = (int(value) for value in self._table[position, 2:4])
        planned_tick = timing.start_tick + int(self._planned_end_tick[position]) - on_ticks
        error = timing.to_board_tick(planned_tick) - float(self._end_tick[position] - on_ticks)
        # Only dark time is changed, and no more of it than two crystals can drift apart since the point before: pulses
        # keep their width.
        limit = min(RETIMING_MAX_TICKS, ceil(RETIMING_RATE_MAX * (off_ticks + on_ticks)), off_ticks)
        shift = round(max(-limit, min(limit, error)))
        # The dark time is a field of 16 bits; a shift that does not fit waits for the next point.
        if off_ticks + shift <= TICKS_MAX:
            self._table[position, 2] = off_ticks + shift
            self._end_tick[position:] += shift

    def find_start_tick(self) -> int | None:
        """Return the board tick at which the next point begins, None if all were sent.

        A board that does not have it by then waits, and the gate turns on that much later.
        """
        return None if self.is_fully_sent else self.end_tick_after(self.next_to_send - self.first_index)

    def can_truncate(self, kept_points: int) -> bool:
        """Return whether no more than `kept_points` points were sent."""
        # What was sent is final: the board's queue is never edited.
        return self.first_index + kept_points >= self.next_to_send

    def truncate(self, kept_points: int) -> bool:
        """Truncate the job to `kept_points` points. Return False, unchanged, if more were sent."""
        if not self.can_truncate(kept_points):
            return False
        self._count = min(kept_points, self._count)
        return True

    def find_contradiction(self, message: Executed) -> str:
        """Return the first report that cannot be of the point that was sent, '' if all can or are of other jobs."""
        first = message.first_index - self.first_index
        begin, end = max(0, -first), min(len(message.records), self._count - first)
        if begin >= end:
            return ""
        on_tick, on_ticks, duty = np.array(message.records[begin:end], dtype=np.int64).T
        sent = slice(first + begin, first + end)
        sent_on_ticks, sent_duty = self._table[sent, 3].astype(np.int64), self._table[sent, 4]
        # Without the delays: the host may have assumed one that the board did not have.
        earliest_tick = self._end_tick[sent] - self._delayed_ticks - sent_on_ticks - EARLY_MAX_TICKS
        is_early = on_tick < earliest_tick
        is_long = on_ticks > sent_on_ticks + LATE_OFF_MAX_TICKS
        # A dark point has no duty to report.
        is_other = (duty != sent_duty) & (on_ticks > 0)
        if not np.any(is_early | is_long | is_other):
            return ""
        k = int(np.argmax(is_early | is_long | is_other))
        was_sent = f"{sent_on_ticks[k]} ticks with duty {sent_duty[k]} from {earliest_tick[k]} on"
        reported = f"{on_ticks[k]} ticks with duty {duty[k]} from {on_tick[k]} on"
        return f"point {self.first_index + first + begin + k} {reported}, expected at most {was_sent}"

    def record_executed(self, message: Executed) -> None:
        """Record the board's report. Reports of other jobs and repeated reports have no effect."""
        first = message.first_index - self.first_index
        for offset, (on_tick, on_ticks, duty) in enumerate(message.records):
            position = first + offset
            if 0 <= position < self._count and self._on_tick[position] < 0:
                self._on_tick[position] = on_tick
                self._on_ticks[position] = on_ticks
                self._duty[position] = duty
        while self._reported_count < self._count and self._on_tick[self._reported_count] >= 0:
            self._reported_count += 1

    @property
    def is_truncated(self) -> bool:
        """Whether the job was truncated."""
        return self._count < len(self._table)

    def extend(self, points: WirePoints) -> None:
        """Append points behind the last one, with rows of the same plan. The job must not be truncated.

        Other threads may read reports meanwhile: nothing that they read of the earlier points changes.
        """
        ends, fill = points.compute_end_ticks(), np.zeros(len(points), dtype=np.int64)
        for name, added in (
            ("_table", points.table.astype("<u2")),
            ("_planned_end_tick", ends + (int(self._planned_end_tick[-1]) if self._count else 0)),
            ("_end_tick", ends + self.end_tick_after(self._count)),
            ("_on_tick", fill - 1),
            ("_on_ticks", fill),
            ("_duty", fill),
            ("_row", points.row),
        ):
            # New arrays, not appended in place: a reader in another thread keeps the old ones whole.
            setattr(self, name, np.concatenate([getattr(self, name), added]))
        self._pulse_points = np.flatnonzero(self._row >= 0)
        # Last: a reader that sees the new count finds all columns as long.
        self._count += len(points)

    @property
    def first_unreported(self) -> int | None:
        """First index not yet reported, None if all are."""
        return None if self._reported_count == self._count else self.first_index + self._reported_count

    def list_sent_rows(self) -> IntArray:
        """Return the plan rows of the pulses sent so far, in order."""
        return self._row[self._pulse_points[: self.sent_count]]

    @property
    def sent_count(self) -> int:
        """Number of pulses sent so far."""
        return int(np.searchsorted(self._pulse_points, self.next_to_send - self.first_index))

    @property
    def executed_count(self) -> int:
        """Number of pulses reported as executed, without a gap from the first."""
        return int(np.searchsorted(self._pulse_points, self._reported_count))

    def list_executed_rows(self) -> IntArray:
        """Return the plan rows reported as executed, in order."""
        return self._row[self._pulse_points[self._on_tick[self._pulse_points] >= 0]]

    @property
    def pulse_count(self) -> int:
        """Number of pulses among the points."""
        return len(self._pulse_points)

    @property
    def pulse_rows(self) -> IntArray:
        """The plan rows of all pulses, in order."""
        return self._row[self._pulse_points]

    def read_reports(self, pulses: IntArray) -> ReportedPulses:
        """Return the reports of pulses [n], given as their positions among all. on_tick is −1 without a report.

        Any thread may call it.
        """
        points = self._pulse_points[pulses]
        on_tick, on_ticks, duty = self._on_tick[points], self._on_ticks[points], self._duty[points]
        return ReportedPulses(self._row[points], on_tick, on_ticks, duty, self._find_late_ticks(points))

    def _find_late_ticks(self, points: IntArray) -> IntArray:
        """Return how much later than scheduled the light of points began, or ended those that have none, [n]."""
        scheduled = self._end_tick[points] - self._table[points, 3].astype(np.int64)
        return np.asarray(self._on_tick[points] - scheduled, dtype=np.int64)

    def read_reported(self, begin: int, end: int) -> ReportedPulses:
        """Return the reports so far of pulses begin to end, in order of the points. Any thread may call it."""
        reports = self.read_reports(np.arange(len(self._pulse_points))[begin:end])
        done = reports.on_tick >= 0
        return ReportedPulses(*(column[done] for column in reports))

    @property
    def is_finished(self) -> bool:
        """Whether every point was sent and reported as executed."""
        return self.is_fully_sent and self.first_unreported is None

    def build_executed(self, plan: PulsePlan, scale: WireScale) -> ExecutedPulses:
        """Return the reported pulses of `plan`. They are complete if none is missing from the untruncated part."""
        done = self._pulse_points[self._on_tick[self._pulse_points] >= 0]
        row = self.list_executed_rows()
        width_ticks = self._on_ticks[done]
        planned_tick = self.start_tick + plan.start_s[row] / scale.tick_s
        on_tick = find_begin_tick(self._on_tick[done], width_ticks, self._find_late_ticks(done), planned_tick)
        return ExecutedPulses(
            on_tick=on_tick,
            width_ticks=width_ticks,
            pixel=plan.pixel[row],
            power_w=scale.to_power_w(self._duty[done] / DUTY_MAX),
            start_s=np.asarray((on_tick - self.start_tick) * scale.tick_s, dtype=np.float64),
            width_s=np.asarray(width_ticks * scale.tick_s, dtype=np.float64),
            stage=np.zeros(len(row), dtype=np.int64),
            complete=self.is_complete,
        )

    @property
    def is_complete(self) -> bool:
        """Whether no report of a pulse is missing from the untruncated part."""
        done = self._on_tick[self._pulse_points] >= 0
        return int(np.count_nonzero(done)) == int(np.searchsorted(self._pulse_points, self._count))
