"""A board in software that plays into a laser DAC: the daemon sees an ordinary board, with its lease, caps and STOP.

Theory of operation. A laser DAC has a buffer and no rules. The board's rules are those of `BoardCore`, in this
computer's time. What its outputs did is sampled a little later at the points of the DAC and sent in chunks that end
dark, so that the device plays what the board has already executed: late by what waits here and in the device.

- **Bound.** At most about CHUNK_S wait here and two chunks in the device. When this process or the computer dies, the
  device runs empty as after `dac play`, within its format's `host_loss_max_s`.
- **STOP.** A board that is DISARMED or in FAULT has a stopped DAC: the device gets its own stop at once, and what waits
  here is dropped. What was dropped counts as executed, as does what an underrun has lost: heat is never counted short.
- **Rate.** Points are taken as long as the slowest device plays them. A faster device waits for each chunk: then
  dark points are added, during which the mirrors stay. A shorter point shortens the settling time of a move of 2 ms by
  at most 5 µs, what `permit_retiming` permits.
"""

from typing import Any

import numpy as np

from optodrive.core.errors import LinkError
from optodrive.core.laser_power import Curve, compute_duty, compute_power_w
from optodrive.core.types.arrays import IntArray
from optodrive.device.config_sections import DAC_HALF_RANGE_CODES, HALF_RANGE_CODES, POWER_STEPS
from optodrive.link.dac.formats.base import CHUNK_MAX_S, DacFormat, PointTable
from optodrive.link.dac.laser_dac import LaserDac
from optodrive.link.protocol.states import IDLE_STATES, BoardState
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.board_machine import CENTRE_CODE, LogSink
from optodrive.link.simulator.guards import BoardSettings

DAC_CENTRE_CODE, DAC_CODE_MAX = DAC_HALF_RANGE_CODES + 1, 2 * DAC_HALF_RANGE_CODES + 1
CHUNK_S = 0.016
"""Time that a chunk covers; the rest of the longest chunk is room for dark points."""
FILL_MAX_S = 0.04
"""Longest dark lead with which a stream begins. The mirrors reach the board's position in it."""
BACKLOG_MAX_S = 0.1
"""Longest time that may wait here while a job runs."""
WAIT_MAX_S = 0.002
"""Time that a device may wait for a chunk before dark points are added."""
POLLS_BEFORE_S = 0.006
POLL_S = 0.001
TIME_ERROR_US = 1e-3


def build_levels(dac_format: DacFormat, curve: Curve = ()) -> IntArray:
    """Return the level of the DAC for each duty of the board, [65536], rounded down.

    A device that may play slower emits less power for longer. curve: of the laser, by duty and W
    """
    full_power_w = curve[-1][1] if curve else 1.0
    power_w = compute_power_w(np.arange(POWER_STEPS + 1) / POWER_STEPS, full_power_w, curve)
    duty = compute_duty(power_w / dac_format.stretch, full_power_w, curve)
    return np.floor(duty * dac_format.level_max * (1 + 1e-12)).astype(np.int64)


class OutputSampler:
    """Samples of the board's outputs at the points of a laser DAC.

    levels: of the DAC by duty; at_us: time up to which points were taken
    """

    def __init__(self, dac_format: DacFormat, levels: IntArray) -> None:
        self.period_us = 1e6 * dac_format.slowest_point_s
        self.at_us = 0.0
        self._delay_us = dac_format.settling_points * self.period_us
        self._levels = levels
        self._moves: list[tuple[float, int, int]] = [(-np.inf, DAC_CENTRE_CODE, DAC_CENTRE_CODE)]
        self._edges: list[tuple[float, int]] = [(-np.inf, 0)]

    def move_to(self, x: int, y: int, at_us: int) -> None:
        """Record a move of the mirrors to codes of the board."""
        step = HALF_RANGE_CODES / DAC_HALF_RANGE_CODES
        x, y = (min(max(round((code - CENTRE_CODE) / step) + DAC_CENTRE_CODE, 0), DAC_CODE_MAX) for code in (x, y))
        self._moves.append((at_us, x, y))

    def light(self, duty: int, at_us: int) -> None:
        """Record an edge of the gate with its duty, 0 for dark. Devices whose mirrors follow later light up later."""
        if duty:
            self._edges.append((at_us + self._delay_us, int(self._levels[duty])))
        else:
            while self._edges[-1][0] >= at_us:  # of a pulse that is shorter than the delay
                self._edges.pop()
            self._edges.append((at_us, 0))

    def restart(self, at_us: float) -> None:
        """Forget the points that wait, and begin dark at a time. The mirrors stay."""
        self.at_us = at_us
        self._moves = [(-np.inf, *self._moves[-1][1:])]
        self._edges = [(-np.inf, 0)]

    @property
    def position(self) -> tuple[int, int]:
        """Codes of the mirrors at the last point that was taken."""
        return self._moves[0][1:]

    @property
    def is_idle(self) -> bool:
        """Whether only darkness with resting mirrors waits."""
        return len(self._moves) == len(self._edges) == 1 and not self._edges[0][1]

    def take(self, count: int) -> PointTable:
        """Return the next points [n, 3], the last one dark.

        A point is lit only if the gate was on all its time. A dark one has the mirrors' position at its end: they leave
        up to a point early, and rest as long as planned before the next light.
        """
        begin_us = self.at_us + self.period_us * np.arange(count)
        end_us = begin_us + self.period_us - TIME_ERROR_US
        moved_us, x, y = np.array(self._moves).T
        position = np.searchsorted(moved_us, end_us) - 1
        edge_us, level = np.array(self._edges).T
        first = np.searchsorted(edge_us, begin_us + TIME_ERROR_US, side="right") - 1
        is_steady = first == np.searchsorted(edge_us, end_us) - 1
        points = np.column_stack([x[position], y[position], np.where(is_steady, level[first], 0)]).astype(np.int64)
        points[-1, 2] = 0
        self.at_us += self.period_us * count
        self._forget()
        return points

    def _forget(self) -> None:
        for events in (self._moves, self._edges):
            passed = sum(event[0] <= self.at_us + TIME_ERROR_US for event in events)
            del events[: passed - 1]


class DacBoard(BoardCore):
    """A board from power-up on whose outputs are an open laser DAC.

    levels: as `build_levels` gives them
    """

    def __init__(
        self,
        settings: BoardSettings,
        dac: LaserDac,
        levels: IntArray,
        sink: LogSink | None = None,
        seed: int | None = None,
    ) -> None:
        self._dac, self._format = dac, dac.format
        self._sampler = OutputSampler(dac.format, levels)
        self._events: LogSink = sink or (lambda event: None)
        self._is_streaming = False
        self._sent_points = 0
        self._polled_us = 0
        self._ready_us: int | None = None
        chunk_points = int(1e6 * CHUNK_S / self._sampler.period_us)
        self._chunk_points = self._format.points_max if self._format.fixed_length else chunk_points
        self._points_max = min(self._format.points_max, int(CHUNK_MAX_S / self._format.slowest_point_s))
        super().__init__(settings, self._on_event, seed, self._sampler.move_to)

    def advance(self, now_us: int) -> None:
        """Carry out each event due up to now_us, and send the outputs to the DAC.

        Raise LinkError if the DAC is lost.
        """
        super().advance(now_us)
        self._drive(now_us)

    def on_link_lost(self, now_us: int) -> None:
        """Disarm as after an ABORT, and stop the DAC."""
        super().on_link_lost(now_us)
        self._drive(now_us)

    def next_event_us(self) -> int | None:
        """Return the time of the next due event or question to the DAC, None if there is none."""
        event_us = super().next_event_us()
        if not self._is_streaming:
            return event_us
        due_us = int(self._due_us) + 1
        if self._ready_us is None:
            due_us = max(due_us - round(1e6 * POLLS_BEFORE_S), self._polled_us + round(1e6 * POLL_S))
        return due_us if event_us is None else min(event_us, due_us)

    def _on_event(self, event: dict[str, Any]) -> None:
        if event["event"] == "gate":
            self._sampler.light(self.machine.duty if event["on"] else 0, event["t_us"])
        self._events(event)

    # --- the DAC ------------------------------------------------------------------------------------------------

    @property
    def _due_us(self) -> float:
        return self._sampler.at_us + self._chunk_points * self._sampler.period_us

    def _drive(self, now_us: int) -> None:
        """Start, feed or stop the DAC, as the board's state permits."""
        if self.state in (*IDLE_STATES, BoardState.BOOT):
            if self._is_streaming:
                self._stop_dac()
            return
        if not self._is_streaming:
            self._start_dac(now_us)
        try:
            self._feed(now_us)
        except LinkError as error:
            self._on_failure(error)

    def _start_dac(self, now_us: int) -> None:
        """Start the DAC, and fill it with dark points at the mirrors' position."""
        self._dac.start()
        self._is_streaming, self._sent_points = True, 0
        self._sampler.restart(now_us)
        fills = int(FILL_MAX_S / (self._chunk_points * self._format.slowest_point_s))
        while fills and self._dac.is_ready():
            self._play_dark()
            fills -= 1

    def _stop_dac(self) -> None:
        """Stop the DAC at once, and drop the points that wait."""
        self._is_streaming, self._ready_us = False, None
        self._sampler.restart(self.machine.now_us)
        self._dac.stop()

    def _feed(self, now_us: int) -> None:
        """Send the due points, as far as the DAC has room."""
        if self.state not in (BoardState.RUNNING, BoardState.HOLD) and self._sampler.is_idle:
            # A pause between jobs ends a lag.
            self._sampler.at_us = max(self._sampler.at_us, now_us - self._chunk_points * self._sampler.period_us)
        while now_us >= self._due_us - 1e6 * POLLS_BEFORE_S:
            if self._ready_us is None:
                self._polled_us = now_us
                if not self._dac.is_ready():
                    break
                self._ready_us = now_us
            if now_us < self._due_us:
                break
            waited_us = now_us - self._ready_us
            self._ready_us = None
            if self._format.fixed_length and waited_us > self._chunk_points * self._sampler.period_us:
                self._play_dark()
            self._play(self._add_dark(self._sampler.take(self._chunk_points), 1e-6 * waited_us))
        if 1e-6 * (now_us - self._sampler.at_us) > BACKLOG_MAX_S:
            raise LinkError(f"the {self._format.label} takes points more slowly than it should")

    def _add_dark(self, points: PointTable, waited_s: float) -> PointTable:
        """Return points with dark ones behind them, if the DAC has waited for them."""
        if self._format.fixed_length:
            return points
        count = int(waited_s / 2 / self._format.slowest_point_s) if waited_s > WAIT_MAX_S else 0
        count = min(count, self._points_max - len(points))
        while not self._format.accepts_length(len(points) + count):
            count += 1
        return np.concatenate([points, np.tile(points[-1:], (count, 1))])

    def _play_dark(self) -> None:
        """Send a dark chunk, during which the mirrors stay."""
        self._play(np.tile([*self._sampler.position, 0], (self._chunk_points, 1)))

    def _play(self, points: PointTable) -> None:
        data = self._format.pack(points, self._sent_points * self._format.point_ticks)
        self._dac.send(self._format.check(data))
        self._sent_points += len(points)

    def _on_failure(self, error: LinkError) -> None:
        """Stop a DAC that ran empty or refused a chunk. Raise the error if it does not even accept the stop.

        A job has lost light: FAULT. Without one, the next call starts the DAC again.
        """
        self._events({"t_us": self.machine.now_us, "event": "dac", "error": str(error)})
        if self.state in (BoardState.RUNNING, BoardState.HOLD) or not self._sampler.is_idle:
            self.machine.fail("UNDERRUN")
        try:
            self._stop_dac()
        except LinkError:
            raise error from None
