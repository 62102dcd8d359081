"""One plan on its way through the board: what was sent, what came back as executed."""

from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import ExecutedPulses, PulsePlan
from optodrive.link.protocol.messages import Executed
from optodrive.link.protocol.quantisation import WirePoints


class ReportedPulses(NamedTuple):
    """Pulses as executed, all [n]: row of the plan, tick of gate on, ticks of gate on, duty in 1/65535."""

    row: IntArray
    on_tick: IntArray
    on_ticks: IntArray
    duty: IntArray


class PlanJob:
    """Points of one plan. start_tick: the board tick of the plan's zero; indices count over the session.

    ahead_ticks: points leave no longer before they begin; left_tick: when the first one did.
    """

    def __init__(
        self, number: int, points: WirePoints, first_index: int, start_tick: int, send_ahead_ticks: float = inf
    ) -> None:
        self.number = number
        self.first_index = first_index
        self.start_tick = start_tick
        self.next_to_send = first_index
        self.first_sent_tick: float | None = None
        self._send_ahead_ticks = send_ahead_ticks
        self._points = points
        self._count = len(points)
        self._end_tick = start_tick + points.compute_end_ticks()
        self._row = points.row
        self._pulse_points = np.flatnonzero(points.row >= 0)
        self._on_tick = np.full(len(points), -1, dtype=np.int64)
        self._on_ticks = np.zeros(len(points), dtype=np.int64)
        self._duty = np.zeros(len(points), dtype=np.int64)
        self._reported_count = 0

    @property
    def end_index(self) -> int:
        """The index after the last point."""
        return self.first_index + self._count

    def end_tick_after(self, count: int) -> int:
        """When the first `count` points are done, if nothing is late."""
        return int(self._end_tick[count - 1]) if count else self.start_tick

    def delay(self, ticks: int) -> None:
        """What came before it was late: its zero lies so much later."""
        self.start_tick += ticks
        self._end_tick += ticks

    @property
    def is_fully_sent(self) -> bool:
        """Whether nothing of it is left to send."""
        return self.next_to_send == self.end_index

    def count_sendable(self, now_tick: float) -> int:
        """How many points may leave now."""
        position = self.next_to_send - self.first_index
        if self._send_ahead_ticks == inf:
            return self._count - position
        # A point begins where the one before it ends.
        due_count = (
            int(np.searchsorted(self._end_tick[: self._count], now_tick + self._send_ahead_ticks, side="right")) + 1
        )
        return max(0, min(due_count, self._count) - position)

    def take_payload(self, count: int, now_tick: float) -> bytes:
        """The bytes of the next points, which thereby count as sent."""
        if self.first_sent_tick is None:
            self.first_sent_tick = now_tick
        position = self.next_to_send - self.first_index
        self.next_to_send += count
        return self._points.encode_payload(position, count)

    def truncate(self, kept_points: int) -> bool:
        """End after `keep` points; False, and unchanged, where more were sent."""
        if self.first_index + kept_points < self.next_to_send:
            return False
        self._count = min(kept_points, self._count)
        return True

    def record_executed(self, message: Executed) -> None:
        """Take over what the board reports; reports of other jobs and repeated ones change nothing."""
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
    def first_unreported(self) -> int | None:
        """The first index not yet reported, None when all are."""
        return None if self._reported_count == self._count else self.first_index + self._reported_count

    @property
    def sent_count(self) -> int:
        """Pulses of the plan handed to the link so far."""
        return int(np.searchsorted(self._pulse_points, self.next_to_send - self.first_index))

    @property
    def executed_count(self) -> int:
        """Pulses of the plan reported as executed, without a gap from the first."""
        return int(np.searchsorted(self._pulse_points, self._reported_count))

    def list_executed_rows(self) -> IntArray:
        """Rows of the plan reported as executed, in order."""
        return self._row[self._pulse_points[self._on_tick[self._pulse_points] >= 0]]

    @property
    def pulse_count(self) -> int:
        """Pulses of the plan among its points."""
        return len(self._pulse_points)

    def read_reported(self, begin: int, end: int) -> ReportedPulses:
        """What came back so far of the pulses begin to end, counted in order of its points; any thread may ask."""
        pulse_points = self._pulse_points[begin:end]
        done = pulse_points[self._on_tick[pulse_points] >= 0]
        return ReportedPulses(self._row[done], self._on_tick[done], self._on_ticks[done], self._duty[done])

    @property
    def is_finished(self) -> bool:
        """Whether every point was sent, and reported as executed."""
        return self.is_fully_sent and self.first_unreported is None

    def build_executed(self, plan: PulsePlan, full_power_w: float, tick_s: float) -> ExecutedPulses:
        """What the board says it did, as pulses of the plan; complete: all of it, but for what was cut away."""
        done = self._pulse_points[self._on_tick[self._pulse_points] >= 0]
        row = self.list_executed_rows()
        on_tick, width_ticks = self._on_tick[done], self._on_ticks[done]
        return ExecutedPulses(
            index=self.first_index + done,
            on_tick=on_tick,
            width_ticks=width_ticks,
            pixel=plan.pixel[row],
            power_w=self._duty[done] / 65535.0 * full_power_w,
            start_s=np.asarray((on_tick - self.start_tick) * tick_s, dtype=np.float64),
            width_s=np.asarray(width_ticks * tick_s, dtype=np.float64),
            complete=len(done) == int(np.searchsorted(self._pulse_points, self._count)),
        )
