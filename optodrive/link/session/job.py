"""One plan on its way through the board: what was sent, what came back as executed."""

from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import ExecutedPulses, PulsePlan
from optodrive.link.protocol.messages import Executed
from optodrive.link.protocol.quantisation import WirePoints


class Reported(NamedTuple):
    """Pulses as executed, all [n]: row of the plan, tick of gate on, ticks of gate on, duty in 1/65535."""

    row: IntArray
    on_tick: IntArray
    on_ticks: IntArray
    duty: IntArray


class Job:
    """Points of one plan. start_tick: the board tick of the plan's zero; indices count over the session.

    ahead_ticks: points leave no longer before they begin; left_tick: when the first one did.
    """

    def __init__(
        self, number: int, points: WirePoints, first_index: int, start_tick: int, ahead_ticks: float = inf
    ) -> None:
        self.number = number
        self.first_index = first_index
        self.start_tick = start_tick
        self.next_to_send = first_index
        self.left_tick: float | None = None
        self._ahead_ticks = ahead_ticks
        self._points = points
        self._count = len(points)
        self._end_tick = start_tick + points.ends()
        self._row = points.row
        self._lit = np.flatnonzero(points.row >= 0)
        self._on_tick = np.full(len(points), -1, dtype=np.int64)
        self._on_ticks = np.zeros(len(points), dtype=np.int64)
        self._duty = np.zeros(len(points), dtype=np.int64)
        self._reported_to = 0

    @property
    def end_index(self) -> int:
        """The index after the last point."""
        return self.first_index + self._count

    def end_tick_of(self, count: int) -> int:
        """When the first `count` points are done, if nothing is late."""
        return int(self._end_tick[count - 1]) if count else self.start_tick

    def later(self, ticks: int) -> None:
        """What came before it was late: its zero lies so much later."""
        self.start_tick += ticks
        self._end_tick += ticks

    @property
    def all_sent(self) -> bool:
        """Whether nothing of it is left to send."""
        return self.next_to_send == self.end_index

    def leaving(self, now_tick: float) -> int:
        """How many points may leave now."""
        at = self.next_to_send - self.first_index
        if self._ahead_ticks == inf:
            return self._count - at
        # A point begins where the one before it ends.
        begun = int(np.searchsorted(self._end_tick[: self._count], now_tick + self._ahead_ticks, side="right")) + 1
        return max(0, min(begun, self._count) - at)

    def take(self, count: int, now_tick: float) -> bytes:
        """The bytes of the next points, which thereby count as sent."""
        if self.left_tick is None:
            self.left_tick = now_tick
        at = self.next_to_send - self.first_index
        self.next_to_send += count
        return self._points.payload(at, count)

    def cut(self, keep: int) -> bool:
        """End after `keep` points; False, and unchanged, where more were sent."""
        if self.first_index + keep < self.next_to_send:
            return False
        self._count = min(keep, self._count)
        return True

    def note(self, message: Executed) -> None:
        """Take over what the board reports; reports of other jobs and repeated ones change nothing."""
        first = message.first_index - self.first_index
        for offset, (on_tick, on_ticks, duty) in enumerate(message.records):
            position = first + offset
            if 0 <= position < self._count and self._on_tick[position] < 0:
                self._on_tick[position] = on_tick
                self._on_ticks[position] = on_ticks
                self._duty[position] = duty
        while self._reported_to < self._count and self._on_tick[self._reported_to] >= 0:
            self._reported_to += 1

    @property
    def first_missing(self) -> int | None:
        """The first index not yet reported, None when all are."""
        return None if self._reported_to == self._count else self.first_index + self._reported_to

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
    def pulses(self) -> int:
        """Pulses of the plan among its points."""
        return len(self._lit)

    def reported(self, begin: int, end: int) -> Reported:
        """What came back so far of the pulses begin to end, counted in order of its points; any thread may ask."""
        lit = self._lit[begin:end]
        done = lit[self._on_tick[lit] >= 0]
        return Reported(self._row[done], self._on_tick[done], self._on_ticks[done], self._duty[done])

    @property
    def finished(self) -> bool:
        """Whether every point was sent, and reported as executed."""
        return self.all_sent and self.first_missing is None

    def executed(self, plan: PulsePlan, full_power_w: float, tick_s: float) -> ExecutedPulses:
        """What the board says it did, as pulses of the plan; complete: all of it, but for what was cut away."""
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
            complete=len(done) == int(np.searchsorted(self._lit, self._count)),
        )
