"""Each impossible report is a fault of the link, in one line, and none changes the state that the host knows."""

from dataclasses import replace

import pytest

from optodrive.core.clock import ManualClock
from optodrive.core.errors import LinkError
from optodrive.link.protocol import messages as m
from optodrive.link.session import report_check
from optodrive.link.session.clock_sync import ClockSync
from optodrive.link.session.point_stream import PointStream
from optodrive.link.session.report_check import FalseReportError, ReportCheck
from optodrive.link.simulator.guards import DEFAULT_LIMITS
from wire_points import build_points

NOW_S = 10.0
BOARD_S = 110.0
TICK_S = 1e-6
START_TICK = 109_000_000
DUTY, DARK_TICKS, ON_TICKS = 1000, 2000, 200
FIRST_ON_TICK = START_TICK + DARK_TICKS
QUEUE_POINTS = 60
HELLO = m.HelloReply(1, 0, 5, 7, 1, bytes(12), 0, 1_000_000, QUEUE_POINTS, 8, 1, 9, 9, 0, DEFAULT_LIMITS)
TICK = round(BOARD_S / TICK_S)
ARMED, FAULT = m.STATES.index("ARMED"), m.STATES.index("FAULT")
STATUS = m.Status(ARMED, 0, 3, TICK, 20, 30, 0, 0, 0, 0, 4000, 250, 0, 0, 0)
EVENT = m.Event(ARMED, 0, 0, TICK)
ACK = m.Ack(3, QUEUE_POINTS, 20, ARMED)


class SentPoints(PointStream):
    """Fifty points of which forty were sent."""

    def __init__(self):
        super().__init__()
        job = self.begin(build_points(50, DUTY), START_TICK)
        job.take_payload(40, 0.0)
        self._sent_index = 40


class Bench:
    def __init__(self):
        self.clock = ManualClock(NOW_S)
        self.sync = ClockSync()
        self.exchange(BOARD_S)
        self.check = ReportCheck(self.sync, SentPoints(), TICK_S)
        self.accept(HELLO)

    def exchange(self, board_s, width_s=0.002):
        self.sync.finish_exchange(self.sync.start_exchange(NOW_S - width_s), NOW_S, board_s)

    def accept(self, message):
        return self.check.accept(message, self.clock.now_s())

    def reply(self, after_s, off_s):
        """Return the reply to an exchange some time later, off by off_s."""
        stamp = self.sync.start_exchange(self.clock.now_s() + after_s - 0.002)
        self.clock.sleep(after_s)
        return m.ClockReply(stamp, round((BOARD_S + after_s + off_s) / TICK_S))


def build_report(first_index=0, count=3, late_ticks=0, **changes):
    """Return the honest report of points, with its first record changed."""
    records = [(FIRST_ON_TICK + late_ticks + k * (DARK_TICKS + ON_TICKS), ON_TICKS, DUTY) for k in range(50)]
    records = records[first_index : first_index + count]
    record = dict(zip(("on_tick", "on_ticks", "duty"), records[0], strict=True)) | changes
    return m.Executed(first_index, (tuple(record.values()), *records[1:]))


POSSIBLE = {
    "HELLO_REPLY": HELLO,
    "ACK": ACK,
    "STATUS": STATUS,
    "STATUS of a fault": replace(STATUS, state=FAULT, fault=1),
    "EVENT": EVENT,
    "EXECUTED": build_report(),
    "EXECUTED late": build_report(late_ticks=500_000),
    "EXECUTED of an interrupted pulse": build_report(count=1, on_ticks=7),
    "EXECUTED of the last point that was sent": build_report(first_index=39, count=1),
}


@pytest.mark.parametrize("name", POSSIBLE)
def test_possible_reports_are_accepted(name):
    assert Bench().accept(POSSIBLE[name])


FALSE = {
    "no session": (replace(HELLO, session=0), "session 0 in HELLO_REPLY, expected at least 1"),
    "no queue": (replace(HELLO, queue_points=0), "queue_points 0"),
    "no window": (replace(HELLO, rx_window=0), "rx_window 0"),
    "cells without size": (replace(HELLO, cell_codes=0), "cell_codes 0"),
    "no cells": (replace(HELLO, cells=0), "cells 0"),
    "no pulses": (replace(HELLO, window_pulses=0), "window_pulses 0"),
    "more room than the queue": (replace(ACK, free_points=61), "free_points 61 in ACK, expected at most 60"),
    "more done than sent": (replace(ACK, done_index=41), "done_index 41 in ACK, expected at most 40, the points sent"),
    "more queued than the queue holds": (replace(STATUS, queued=61), "queued 61"),
    "more done than sent, in STATUS": (replace(STATUS, done_index=41), "done_index 41"),
    "an unknown input": (replace(STATUS, inputs=8), "inputs 8"),
    "a fault in ARMED": (replace(STATUS, fault=2), "fault RANGE in STATUS, expected one in FAULT only"),
    "FAULT without a fault": (replace(EVENT, state=FAULT), "fault none in EVENT"),
    "a tick to come": (replace(STATUS, tick=TICK + 30_000), "the present one"),
    "an event to come": (replace(EVENT, tick=2**63), "the present one"),
    "points that were not sent": (build_report(first_index=39, count=2), "end 41 in EXECUTED"),
    "an index beyond all": (m.Executed(2**32 - 3, build_report().records), "end 4294967296"),
    "a tick of no clock": (build_report(count=1, on_tick=2**63), "the present one"),
    "a point before its time": (
        build_report(on_tick=FIRST_ON_TICK - 11),
        "expected at most 200 ticks with duty 1000 from",
    ),
    "a point at power-up": (build_report(on_tick=0), "from 0 on"),
    "a pulse that is too long": (build_report(on_ticks=ON_TICKS + 101), "301 ticks"),
    "a pulse of another power": (build_report(duty=DUTY + 1), "duty 1001"),
    "points that overlap": (build_report(on_ticks=3000), "the end of the one before"),
}


@pytest.mark.parametrize("name", FALSE)
def test_a_report_that_cannot_be_is_a_fault_of_the_link(name):
    message, says = FALSE[name]
    with pytest.raises(FalseReportError, match="the board reports") as caught:
        Bench().accept(message)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, LinkError)


@pytest.mark.parametrize(("after_s", "off_s"), [(0.1, 0.0), (0.1, 0.0024), (1.0, 0.006), (1.0, -0.006), (100.0, 0.4)])
def test_a_clock_may_be_slow_and_an_exchange_late(after_s, off_s):
    bench = Bench()
    assert bench.accept(bench.reply(after_s, off_s))


@pytest.mark.parametrize(("after_s", "off_s"), [(0.1, 0.003), (0.1, -0.003), (1.0, 0.0075), (1.0, -100.0), (10.0, 1e3)])
def test_a_clock_does_not_jump(after_s, off_s):
    bench = Bench()
    with pytest.raises(FalseReportError, match="a clock that goes on evenly"):
        bench.accept(bench.reply(after_s, off_s))


def test_a_clock_of_centuries_is_none():
    bench = Bench()
    with pytest.raises(FalseReportError, match="expected at most 9007199254740992"):
        bench.accept(m.ClockReply(0, 2**64 - 1))


def test_older_reports_change_nothing():
    bench = Bench()
    assert bench.accept(STATUS)
    assert bench.accept(replace(EVENT, tick=TICK + 1))
    assert not bench.accept(STATUS)
    assert bench.accept(replace(STATUS, tick=TICK + 1))
    bench.accept(HELLO)
    assert bench.accept(STATUS), "a session begins with the first report of its board"


def test_a_tick_to_come_is_noticed_once_the_clock_is_known():
    bench = Bench()
    unknown = ReportCheck(ClockSync(), SentPoints(), TICK_S)
    unknown.accept(HELLO, NOW_S)
    unknown.accept(replace(STATUS, tick=2**40), NOW_S)
    unknown._clock_sync = bench.sync
    with pytest.raises(FalseReportError, match=str(2**40)):
        unknown.accept(STATUS, NOW_S)


def test_a_limit_of_the_check_counts(monkeypatch):
    """Mutant: with more room for a clock that seems ahead, a tick to come passes."""
    monkeypatch.setattr(report_check, "AHEAD_MAX_S", 0.1)
    assert Bench().accept(FALSE["a tick to come"][0])
