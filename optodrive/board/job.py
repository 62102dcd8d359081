"""One plan on its way through the board: what was sent, what came back as executed."""

import numpy as np

from optodrive.flow import ExecutedPulses, IntArray, PulsePlan
from optodrive.wire.messages import Executed
from optodrive.wire.quantise import WirePoints


class Job:
    """Points of one plan. start_tick: the board tick of the plan's zero; indices count over the session."""

    def __init__(self, job_id: int, points: WirePoints, first_index: int, start_tick: int) -> None:
        self.job_id = job_id
        self.first_index = first_index
        self.end_index = first_index + len(points)
        self.start_tick = start_tick
        self.next_to_send = first_index
        self.started = False
        self.end_sent = False
        self._row = points.row
        self._lit = np.flatnonzero(points.row >= 0)
        self._on_tick = np.full(len(points), -1, dtype=np.int64)
        self._on_ticks = np.zeros(len(points), dtype=np.int64)
        self._duty = np.zeros(len(points), dtype=np.int64)
        self._reported_to = 0

    def note(self, message: Executed) -> None:
        """Take over what the board reports; reports of other jobs and repeated ones change nothing."""
        first = message.first_index - self.first_index
        for offset, (on_tick, on_ticks, duty) in enumerate(message.records):
            position = first + offset
            if 0 <= position < len(self._on_tick) and self._on_tick[position] < 0:
                self._on_tick[position] = on_tick
                self._on_ticks[position] = on_ticks
                self._duty[position] = duty
        while self._reported_to < len(self._on_tick) and self._on_tick[self._reported_to] >= 0:
            self._reported_to += 1

    @property
    def first_missing(self) -> int | None:
        """The first index not yet reported, None when all are."""
        return None if self._reported_to == len(self._on_tick) else self.first_index + self._reported_to

    @property
    def sent_rows(self) -> int:
        """Pulses of the plan handed to the link so far."""
        return int(np.searchsorted(self._lit, self.next_to_send - self.first_index))

    @property
    def executed_rows(self) -> int:
        """Pulses of the plan reported as executed, without a gap from the first."""
        return int(np.searchsorted(self._lit, self._reported_to))

    def rows_executed(self) -> IntArray:
        """Rows of the plan reported as executed, in order."""
        return self._row[self._lit[self._on_tick[self._lit] >= 0]]

    @property
    def finished(self) -> bool:
        """Whether every point was reported as executed."""
        return self.end_sent and self.first_missing is None

    def executed(self, plan: PulsePlan, full_power_w: float, tick_s: float) -> ExecutedPulses:
        """What the board says it did, as pulses of the plan."""
        done = self._lit[self._on_tick[self._lit] >= 0]
        row = self.rows_executed()
        on_tick, width_ticks = self._on_tick[done], self._on_ticks[done]
        return ExecutedPulses(
            index=self.first_index + done,
            on_tick=on_tick,
            width_ticks=width_ticks,
            pixel=plan.pixel[row],
            power_w=self._duty[done] / 65535.0 * full_power_w,
            start_s=np.asarray((on_tick - self.start_tick) * tick_s, dtype=np.float64),
            width_s=np.asarray(width_ticks * tick_s, dtype=np.float64),
            complete=len(done) == len(self._lit),
        )
