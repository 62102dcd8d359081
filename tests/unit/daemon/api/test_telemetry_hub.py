"""Telemetry hub: each reader gets the newest events and every batch of pulses once."""

import asyncio
import json

import numpy as np
import pytest

from optodrive.core.errors import NotReadyError
from optodrive.core.ipc import Message
from optodrive.daemon.api import telemetry_hub
from optodrive.daemon.api.telemetry_hub import COLUMNS, TelemetryHub, decode_peaks
from optodrive.daemon.engine.telemetry_events import build_display_event
from optodrive.daemon.responses.state import StateReport
from optodrive.daemon.responses.telemetry import DisplayEvent, PulsesEvent
from optodrive.physics.nominal_display import DisplayState

BOARD = dict.fromkeys(("inputs", "done_index", "queued", "free_points", "underruns", "crc_errors"), 0)
BOARD |= {"format_errors": 0, "seq_errors": 0, "laser_on_s": 0.0, "temperature_c": None, "uid": "", "firmware": 1}
LINK = dict.fromkeys(("host_bad_frames", "retransmitted", "naks", "board_bad_frames", "underruns"), 0)
LINK |= {
    "limitation": None,
    "round_trip_ms": None,
    "silence_s": None,
    "longest_stall_ms": 0.0,
    "likely_cause": None,
    "likely_cause_age_s": None,
}


def build_state(board="DISARMED", fault=None, error=None):
    return StateReport.model_validate(
        {
            "display": "d",
            "pixels": 16,
            "link": LINK | {"port": "p", "state": "down" if error else "up", "error": error},
            "board": BOARD | {"state": board, "fault": fault, "hint": ""},
            "stages": [],
            "control": None,
            "limits": {"power_share": 1.0},
            "queue": {"waiting": 0, "running": None, "active": [], "plans": []}
            | {"paused": False, "pause_ends_in_s": None},
            "totals": {"planned": 0, "sent": 0, "executed": 0, "timing_error": None},
            "planner": {"busy": False, "alive": True},
        }
    )


def build_event(kind, text, warm=True):
    fields = {"event": kind, "warm": warm, "upcoming": False}
    return Message("telemetry", fields, text.encode())


def build_display(peaks_um, height_um=0.0):
    """Build the display event of a few pixels with these peaks."""
    heights, peaks = (np.array(each) * 1e-6 for each in (np.full(len(peaks_um), height_um), peaks_um))
    state, peaks = DisplayState(heights, 0.0 * heights), DisplayState(peaks, 1e6 * peaks)
    display = build_display_event(1.5, True, state, peaks, 0.0)
    return build_event("display", display.model_dump_json())


def read_peaks_um(data):
    heights, temperatures = decode_peaks(DisplayEvent.model_validate_json(data)).tolist()
    assert temperatures == heights  # as built above, 1 °C per µm
    return heights


def build_batch(plan, rows, kind="executed"):
    columns = ("row", "pixel", "start_s", "width_s", "power_w", "trimmed_j")
    batch = {"plan": plan, "name": "n", **dict.fromkeys(columns, rows), "reason": [""] * len(rows)}
    fields = {"number": 0, "batch": kind, "count": len(rows), "board_s": 1.5}
    return Message("pulses", fields, json.dumps(batch).encode())


class Reader:
    """Reader of a hub.

    events: (kind, data) received so far
    """

    def __init__(self, hub, rate_hz=60.0):
        self.events = []
        self._task = asyncio.create_task(self._read(hub.stream_events(rate_hz)))

    async def _read(self, stream):
        async for text in stream:
            for event in text.decode().strip().split("\n\n"):
                kind, data = event.split("\n")
                self.events.append((kind.removeprefix("event: "), data.removeprefix("data: ")))

    async def until(self, count):
        while len(self.events) < count:
            await asyncio.sleep(0.002)
        return self.events

    async def leave(self):
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await asyncio.sleep(0)


def run(scenario):
    return asyncio.run(scenario(TelemetryHub()))


def test_a_reader_gets_the_latest_of_each_kind_and_then_only_changes():
    async def scenario(hub):
        hub.publish_state(build_state())
        hub.receive(build_display([1.0]))
        hub.receive(build_display([2.0]))
        reader = Reader(hub)
        assert [kind for kind, _ in await reader.until(3)] == ["state", "fault", "display"]
        assert read_peaks_um(reader.events[2][1]) == [20]
        hub.publish_state(build_state())
        hub.receive(build_event("budget", "3"))
        assert (await reader.until(4))[3:] == [("budget", "3")]
        hub.publish_state(build_state("FAULT", "LINK"))
        later = [kind for kind, _ in (await reader.until(6))[4:]]
        assert sorted(later) == ["fault", "state"]
        await reader.leave()

    run(scenario)


def test_a_reader_gets_the_peaks_of_the_displays_that_it_has_missed():
    """The events of the planner follow the fastest reader. The others see every peak as well, and only once."""

    async def scenario(hub):
        fast, slow = Reader(hub, 60.0), Reader(hub, 1.0)
        await asyncio.sleep(0)
        for number, peaks in enumerate([[30.0, 0.0], [150.0, 4.0], [5.0, 6.0]]):
            hub.receive(build_display(peaks, height_um=3.0))
            await fast.until(number + 1)
        assert [read_peaks_um(data) for _, data in fast.events] == [[300, 0], [1500, 40], [50, 60]]
        ((_, data),) = await slow.until(1)
        assert read_peaks_um(data) == [1500, 60]
        others = dict.fromkeys(COLUMNS)
        assert json.loads(data) | others == json.loads(fast.events[-1][1]) | others
        hub.receive(build_display([7.0, 8.0]))
        assert read_peaks_um((await slow.until(2))[1][1]) == [70, 80]
        await fast.leave()
        await slow.leave()

    run(scenario)


def test_every_batch_of_pulses_reaches_every_reader_once():
    async def scenario(hub):
        first = Reader(hub)
        hub.receive(build_batch("p1", [0, 1]))
        await first.until(1)
        hub.receive(build_batch("p1", [2]))
        hub.receive(build_batch("p2", [0], "planned"))
        second = Reader(hub)
        await first.until(2)
        await second.until(1)
        for reader in (first, second):
            events = [PulsesEvent.model_validate_json(data) for _, data in reader.events]
            executed = [row for event in events for batch in event.executed for row in batch.row]
            planned = [batch.plan for event in events for batch in event.planned]
            assert (executed, planned) == ([0, 1, 2], ["p2"])
            assert events[0].board_s == 1.5
        await first.leave()
        await second.leave()

    run(scenario)


def test_a_slow_reader_gets_the_newest_pulses(monkeypatch):
    monkeypatch.setattr(telemetry_hub, "PULSES_MAX", 3)

    async def scenario(hub):
        for number in range(5):
            hub.receive(build_batch("p", [number]))
        reader = Reader(hub)
        ((_, data),) = await reader.until(1)
        assert [batch.row for batch in PulsesEvent.model_validate_json(data).executed] == [[2], [3], [4]]
        assert len(hub._batches) == 3  # older ones are never sent, and not kept
        await reader.leave()

    run(scenario)


def test_the_planner_is_told_of_the_readers_and_their_highest_rate():
    async def scenario(hub):
        calls = []
        hub.on_readers = lambda *readers: calls.append(readers)
        first, second = Reader(hub, 10.0), Reader(hub, 50.0)
        await asyncio.sleep(0.01)
        hub.receive(build_display([1.0]))
        hub.receive(build_batch("old", [0]))
        await first.leave()
        await second.leave()
        assert calls == [(1, 10.0), (2, 50.0), (1, 50.0), (0, telemetry_hub.DEFAULT_RATE_HZ)]
        hub.publish_state(build_state())
        third = Reader(hub)
        await third.until(2)
        await asyncio.sleep(0.1)
        assert [kind for kind, _ in third.events] == ["state", "fault"]  # the planner sends the others anew
        await third.leave()

    run(scenario)


def test_readers_are_bounded_and_end_with_the_hub(monkeypatch):
    monkeypatch.setattr(telemetry_hub, "READERS_MAX", 1)

    async def scenario(hub):
        hub.require_capacity()
        stream = hub.stream_events(60.0)
        hub.publish_state(build_state())
        await anext(stream)
        with pytest.raises(NotReadyError, match="1 clients"):
            hub.require_capacity()
        hub.close()
        with pytest.raises(StopAsyncIteration):
            await anext(stream)
        assert hub.readers[0] == 0

    run(scenario)
