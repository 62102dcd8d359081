"""Whether a report of the board can be, checked once, before anything follows from it.

Damaged frames are noticed by their CRC. What passes it and cannot be was falsified, or comes from a broken board: a
fault of the link, after which clock and state are rebuilt from nothing. What is possible but false cannot be noticed
here; the board's own guards and the ABORT at the end of each epoch do not rely on it.
"""

from optodrive.core.errors import LinkError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.states import BoardState
from optodrive.link.session.clock_sync import ClockSync
from optodrive.link.session.point_stream import PointStream

TICK_MAX = 2**53
"""Largest tick, 285 years after power-up: a float holds all up to it."""
INPUTS_MAX = 2 ** len(m.INPUTS) - 1
AHEAD_MAX_S = 0.02
"""Largest time by which a report may seem to be ahead of the board's clock, besides the error of an exchange."""


class FalseReportError(LinkError):
    """A report of the board that cannot be."""


class ReportCheck:
    """Check of all reports in one connection.

    points: those of the session; tick_s: duration of a tick; queue_points: room of the board's queue, 0 before HELLO
    """

    def __init__(self, clock_sync: ClockSync, points: PointStream, tick_s: float) -> None:
        self.queue_points = self._newest_tick = 0
        self._clock_sync = clock_sync
        self._points = points
        self._tick_s = tick_s

    def accept(self, message: m.Message, now_s: float) -> bool:
        """Return whether to process a message received at host time now_s: not if it is older than one before.

        Raise FalseReportError with the first value that cannot be.
        """
        # Before the order: an old report that cannot be is no less false.
        self._require_possible(message, now_s)
        if isinstance(message, m.Status | m.Event):
            # A repeated frame of an earlier state would end an arming.
            if message.tick < self._newest_tick:
                return False
            self._newest_tick = message.tick
        return True

    def _require_possible(self, message: m.Message, now_s: float) -> None:
        if isinstance(message, m.HelloReply):
            self._check_hello_reply(message)
        elif isinstance(message, m.ClockReply):
            self._check_clock_reply(message, now_s)
        elif isinstance(message, m.Ack):
            self._check_queue(message, "free_points", message.free_points, message.done_index)
        elif isinstance(message, m.Status):
            self._check_queue(message, "queued", message.queued, message.done_index)
            self._check_state(message, now_s)
            _require(message, "inputs", message.inputs, message.inputs <= INPUTS_MAX, f"at most {INPUTS_MAX}")
        elif isinstance(message, m.Event):
            self._check_state(message, now_s)
        elif isinstance(message, m.Executed):
            self._check_executed(message, now_s)

    def _check_hello_reply(self, reply: m.HelloReply) -> None:
        for name in ("session", "queue_points", "rx_window", "cell_codes", "cells", "window_pulses"):
            value = getattr(reply, name)
            _require(reply, name, value, value > 0, "at least 1")
        # The board may have restarted, so that its ticks begin anew.
        self.queue_points, self._newest_tick = reply.queue_points, 0

    def _check_clock_reply(self, reply: m.ClockReply, now_s: float) -> None:
        _require(reply, "tick", reply.tick, reply.tick <= TICK_MAX, f"at most {TICK_MAX}")
        excess_s = self._clock_sync.compute_contradiction_s(reply.host_t, now_s, reply.tick * self._tick_s)
        expected = f"a clock that goes on evenly; it is off by at least {excess_s:.3g} s"
        _require(reply, "tick", reply.tick, excess_s == 0.0, expected)

    def _check_queue(self, message: m.Message, name: str, count: int, done_index: int) -> None:
        _require(message, name, count, count <= self.queue_points, f"at most {self.queue_points}, the queue's room")
        sent_index = self._points.sent_index
        _require(message, "done_index", done_index, done_index <= sent_index, f"at most {sent_index}, the points sent")

    def _check_state(self, message: m.Status | m.Event, now_s: float) -> None:
        # Also the newest so far: a tick from the future would make all later reports look old.
        self._check_tick(message, max(message.tick, self._newest_tick), now_s)
        state, fault = m.STATES[message.state], m.FAULTS[message.fault]
        is_consistent = (state == BoardState.FAULT) == bool(fault)
        _require(message, "fault", fault or "none", is_consistent, f"one in FAULT only; the state is {state}")

    def _check_tick(self, message: m.Message, tick: int, now_s: float) -> None:
        if self._clock_sync.is_synchronised:
            latest = self._find_latest_tick(now_s)
            _require(message, "tick", tick, tick <= latest, f"at most {latest}, the present one")

    def _find_latest_tick(self, now_s: float) -> int:
        ahead_s = AHEAD_MAX_S + (self._clock_sync.round_trip_s or 0.0)
        return round((self._clock_sync.board_s(now_s) + ahead_s) / self._tick_s)

    def _check_executed(self, message: m.Executed, now_s: float) -> None:
        end_index, sent_index = message.first_index + len(message.records), self._points.sent_index
        _require(message, "end", end_index, end_index <= sent_index, f"at most {sent_index}, the points sent")
        off_tick = 0
        for on_tick, on_ticks, _ in message.records:
            _require(message, "tick", on_tick, on_tick >= off_tick, f"at least {off_tick}, the end of the one before")
            # Pulses of one beam cannot overlap, nor come back in time.
            off_tick = on_tick + on_ticks
        self._check_tick(message, off_tick, now_s)
        contradiction = self._points.find_contradiction(message)
        if contradiction:
            raise FalseReportError(f"the board reports {contradiction}")


def _require(message: m.Message, name: str, value: object, is_possible: bool, expected: str) -> None:
    if not is_possible:
        raise FalseReportError(f"the board reports {name} {value} in {message.NAME}, expected {expected}")
