"""The planner's view of one plan's points in the link process."""

from collections.abc import Callable, Sequence

import numpy as np

from optodrive.link.protocol.messages import Executed
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.session.plan_job import PlanJob
from optodrive.link.session.staged_job import StagedJob

EXECUTED_RECORD = np.dtype([("on_tick", "<u8"), ("on_ticks", "<u4"), ("duty", "<u2")])
"""Record of an executed point in a message of kind `executed`."""


class RemoteJob(StagedJob):
    """Points of one plan in the link process, updated from its messages. Indices are the boards' once it has begun.

    number: by which planner and link process call it; start_ticks: at which the points of each stage begin
    send_delay: sends a shift of the zero, given number and ticks
    """

    def __init__(
        self,
        number: int,
        points: StagePoints,
        zero_tick: int,
        send_delay: Callable[[int, int], None],
        start_ticks: Sequence[int] | None = None,
    ) -> None:
        starts = [zero_tick] * len(points.stages) if start_ticks is None else start_ticks
        pairs = zip(points.stages, starts, strict=True)
        super().__init__([PlanJob(number, one, 0, start_tick) for one, start_tick in pairs], zero_tick)
        self.number = number
        self._send_delay = send_delay
        self._first_sent_tick: float | None = None

    @property
    def first_sent_tick(self) -> float | None:
        """Tick of board_s() at which the first point of all was sent, None before."""
        return self._first_sent_tick

    def update(self, first_index: Sequence[int], sent_points: Sequence[int], first_sent_tick: float | None) -> None:
        """Take over the progress that the link process reports."""
        self._first_sent_tick = first_sent_tick
        for part, first, sent in zip(self.parts, first_index, sent_points, strict=True):
            part.first_index, part.next_to_send = first, first + sent

    def delay(self, ticks: int) -> None:
        """Shift the plan's zero, here and in the link process."""
        super().delay(ticks)
        self._send_delay(self.number, ticks)

    def record_reports(self, stage: int, first_point: int, payload: bytes) -> None:
        """Record the reports of a stage's board. first_point: position in this job of the first reported point."""
        records = tuple(np.frombuffer(payload, EXECUTED_RECORD).tolist())
        part = self.parts[stage]
        part.record_executed(Executed(part.first_index + first_point, records))
