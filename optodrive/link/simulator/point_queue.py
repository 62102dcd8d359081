"""The simulated board's queue of points, with their numbers and jobs, and the records of those that it executed."""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from optodrive.link.protocol import messages as m


class QueuedPoint(NamedTuple):
    """One queued point, numbered over the session, with positions in codes and times in µs."""

    number: int
    x: int
    y: int
    dark_us: int
    on_us: int
    duty: int


@dataclass
class BoardJob:
    """The job between START and its end.

    end_index: number after the last point, None before END
    trigger_delay_us: from the edge that the job awaits to its start, None if it awaits none
    expires_us: when it stops waiting for an edge
    """

    number: int
    start_us: int
    watermark: int
    end_index: int | None = None
    trigger_delay_us: int | None = None
    expires_us: int = 0


class PointQueue:
    """Points in order of their numbers.

    next_index: the number that DATA must continue with; done_index: all points before it are executed or dropped
    """

    def __init__(self) -> None:
        self.job: BoardJob | None = None
        self.next_index = self.done_index = 0
        self._points: deque[QueuedPoint] = deque()

    def __len__(self) -> int:
        return len(self._points)

    @property
    def is_idle(self) -> bool:
        """Whether there is neither a job nor a queued point."""
        return self.job is None and not self._points

    @property
    def first_index(self) -> int:
        """Number of the first queued point, or of the next point to queue."""
        return self._points[0].number if self._points else self.next_index

    @property
    def is_job_done(self) -> bool:
        """Whether the job's last point is executed."""
        return self.job is not None and self.job.end_index is not None and self.done_index >= self.job.end_index

    @property
    def has_enough_points(self) -> bool:
        """Whether the job may execute: the watermark is reached, or all of its points are queued."""
        job = self.job
        if job is None or not self._points:
            return False
        is_complete = job.end_index is not None and self.next_index >= job.end_index
        return is_complete or len(self._points) >= job.watermark

    def append(self, points: Iterable[QueuedPoint]) -> None:
        """Queue points. An idle queue continues with the number of the first one."""
        was_idle = self.is_idle
        for point in points:
            if was_idle:
                self.done_index, was_idle = point.number, False
            self._points.append(point)
            self.next_index = point.number + 1

    def pop(self) -> QueuedPoint:
        """Remove and return the first point."""
        return self._points.popleft()

    def drop(self) -> None:
        """Drop the job and all queued points."""
        self._points.clear()
        self.job = None
        self.done_index = self.next_index

    def reset_indices(self) -> None:
        """Restart the numbering of points at 0. The queue must be empty."""
        self.next_index = self.done_index = 0


RING_RECORDS = 4096


class ExecutionRecord(NamedTuple):
    """One executed point: its number, the tick of gate on, the gate-on time in ticks, the duty."""

    number: int
    on_tick: int
    on_ticks: int
    duty: int


class ExecutionRecords:
    """The last RING_RECORDS records of a session, and those not yet reported."""

    def __init__(self) -> None:
        self._kept: deque[ExecutionRecord] = deque(maxlen=RING_RECORDS)
        self._unreported: list[ExecutionRecord] = []

    def add(self, record: ExecutionRecord) -> None:
        """Add the record of a point that ended."""
        self._kept.append(record)
        self._unreported.append(record)

    def clear(self) -> None:
        """Forget all records."""
        self._kept.clear()
        self._unreported.clear()

    def pop_reports(self) -> list[m.Executed]:
        """Return the reports of all records not yet reported."""
        reports = []
        while self._unreported:
            count = count_reportable(self._unreported)
            reports.append(_build_report(self._unreported[:count]))
            del self._unreported[:count]
        return reports

    def build_report(self, first_index: int) -> m.Executed | None:
        """Return the first report of records from first_index on, None if there are none."""
        records = [record for record in self._kept if record.number >= first_index]
        return _build_report(records[: count_reportable(records)]) if records else None


def count_reportable(records: Sequence[ExecutionRecord]) -> int:
    """Return how many leading records fit one EXECUTED: consecutive numbers, offsets of 32 bits."""
    count = 0
    for record in records[: m.RECORDS_MAX]:
        if record.number != records[0].number + count or record.on_tick - records[0].on_tick >= 1 << 32:
            break
        count += 1
    return count


def _build_report(records: Sequence[ExecutionRecord]) -> m.Executed:
    return m.Executed(records[0].number, tuple((record.on_tick, record.on_ticks, record.duty) for record in records))
