"""The simulated board's point queue: points, their numbers, and the job they belong to."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple


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
