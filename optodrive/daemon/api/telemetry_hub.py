"""Telemetry as server-sent events: state, display, pulses, budget, fault.

The planner process produces the display, pulses and budget events as text; this hub makes the state and fault events
and distributes all of them. Readers pull: a slow reader receives the newest events when it is ready, and nothing waits
for it.
"""

import asyncio
from base64 import b64decode, b64encode
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import NamedTuple

import numpy as np
from starlette.responses import StreamingResponse

from optodrive.core.clock import Clock, MonotonicClock
from optodrive.core.errors import NotReadyError
from optodrive.core.ipc import Message
from optodrive.core.types.arrays import IntArray
from optodrive.daemon.responses.state import StateReport
from optodrive.daemon.responses.telemetry import DisplayEvent, FaultEvent

COLUMNS = ("height_peak", "absorber_peak")


def decode_peaks(event: DisplayEvent) -> IntArray:
    """Return the peaks [2, p] of a display event, of COLUMNS in their units."""
    return np.stack([np.frombuffer(b64decode(getattr(event, name)), dtype="<u2") for name in COLUMNS]).astype(np.int64)


class PeakHold:
    """Highest peaks of every pixel over the display events since the one that a reader received last."""

    def __init__(self) -> None:
        self._peaks: IntArray | None = None
        self._count = 0

    def add(self, peaks: IntArray) -> None:
        """Add the peaks [2, p] of a new event."""
        self._peaks = peaks if self._peaks is None else np.maximum(self._peaks, peaks)
        self._count += 1

    def release(self, newest: DisplayEvent) -> DisplayEvent:
        """Return the newest event with the peaks of all that were added, unchanged if it is alone. Begin anew."""
        peaks, count = self._peaks, self._count
        self._peaks, self._count = None, 0
        if peaks is None or count == 1:
            return newest
        columns = zip(COLUMNS, peaks.astype("<u2"), strict=True)
        return newest.model_copy(update={name: b64encode(column.tobytes()).decode() for name, column in columns})


DEFAULT_RATE_HZ = 30.0
IDLE_RATE_HZ = 20.0
READERS_MAX = 64
STATE_PERIOD_S, PULSES_PERIOD_S = 0.5, 0.08
BATCHES_MAX = 300
"""Batches of pulses that are kept for slow readers."""
PULSES_MAX = 6000
"""Pulses of one event, and of all kept batches."""


class EventStream(StreamingResponse):
    """A response of server-sent events."""

    media_type = "text/event-stream"

    def __init__(self, events: AsyncIterator[bytes]) -> None:
        super().__init__(events, headers={"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"})


class _Batch(NamedTuple):
    number: int
    pulse_count: int
    kind: str
    text: str


class TelemetryHub:
    """Latest events for up to READERS_MAX readers. The web server's thread calls everything.

    on_readers: called with the number of readers and their highest rate, 1/s, whenever they change
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self.on_readers: Callable[[int, float], None] = lambda readers, rate_hz: None
        self._clock = clock or MonotonicClock()
        self._rates_hz: list[float] = []
        self._closed = False
        self._latest: dict[str, tuple[int, str]] = {}
        self._display: DisplayEvent | None = None
        self._holds: list[PeakHold] = []
        self._event_number = 0
        self._batches: deque[_Batch] = deque(maxlen=BATCHES_MAX)
        self._batch_number = 0
        self._board_s = 0.0
        self._state_due_s = -float("inf")
        self._state_key: object = None
        self._fault_key: object = None
        self._is_busy = False

    def close(self) -> None:
        """End all event streams at their next event."""
        self._closed = True

    @property
    def readers(self) -> tuple[int, float]:
        """Number of readers and their highest rate, 1/s."""
        return len(self._rates_hz), max(self._rates_hz, default=DEFAULT_RATE_HZ)

    def require_capacity(self) -> None:
        """Raise NotReadyError if there are too many readers."""
        if len(self._rates_hz) >= READERS_MAX:
            raise NotReadyError(f"{READERS_MAX} clients read the telemetry already")

    # --- events -------------------------------------------------------------------------------------------------

    def receive(self, message: Message) -> None:
        """Take an event, or a batch of pulses, from the planner process."""
        fields = message.fields
        if message.kind == "telemetry":
            self._is_busy = bool(fields["warm"] or fields["upcoming"])
            if fields["event"] == "display":
                self._hold_peaks(DisplayEvent.model_validate_json(message.payload))
            self._set_latest(str(fields["event"]), message.payload.decode())
        elif message.kind == "pulses":
            self._batch_number += 1
            self._board_s = fields["board_s"]
            text = message.payload.decode()
            self._batches.append(_Batch(self._batch_number, fields["count"], str(fields["batch"]), text))
            kept_pulses = sum(batch.pulse_count for batch in self._batches)
            while kept_pulses > PULSES_MAX:
                kept_pulses -= self._batches.popleft().pulse_count

    def publish_state(self, state: StateReport) -> None:
        """Make the state event if the state has changed or the event is due, and the fault event if that has changed.

        Call it whenever a status of the link or planner process has arrived.
        """
        board, link, now_s = state.board, state.link, self._clock.now_s()
        plans = tuple((plan.plan, plan.status) for plan in state.queue.plans)
        key = (board.state, board.fault, board.inputs, link.state, state.planner.busy, plans, state.limits)
        if key != self._state_key or now_s >= self._state_due_s:
            self._state_key, self._state_due_s = key, now_s + STATE_PERIOD_S
            self._set_latest("state", state.model_dump_json())
        fault_key = board.fault, board.hint, link.error
        if fault_key != self._fault_key:
            self._fault_key = fault_key
            fault, hint, link_error = fault_key
            event = FaultEvent(board=board.state, link=link.state, fault=fault, hint=hint, link_error=link_error)
            self._set_latest("fault", event.model_dump_json())

    def _set_latest(self, kind: str, text: str) -> None:
        self._event_number += 1
        self._latest[kind] = self._event_number, _format_event(kind, text)

    def _hold_peaks(self, display: DisplayEvent) -> None:
        self._display, peaks = display, decode_peaks(display)
        for hold in self._holds:
            hold.add(peaks)

    # --- readers ------------------------------------------------------------------------------------------------

    async def stream_events(self, rate_hz: float = DEFAULT_RATE_HZ) -> AsyncIterator[bytes]:
        """Yield the new events for one reader every 1 / rate_hz seconds, until it disconnects."""
        event_number = batch_number = 0
        next_s, pulses_s = self._clock.now_s(), 0.0
        hold = PeakHold()
        self._add_reader(rate_hz, hold)
        try:
            while not self._closed:
                text = self._format_since(event_number, hold)
                event_number = self._event_number
                now_s = self._clock.now_s()
                if self._newest_batch > batch_number and now_s >= pulses_s:
                    text += self._format_pulses_since(batch_number)
                    batch_number, pulses_s = self._batch_number, now_s + PULSES_PERIOD_S
                if text:
                    yield text.encode()
                is_busy = self._is_busy or self._newest_batch > batch_number
                next_s = max(next_s + 1.0 / (rate_hz if is_busy else min(rate_hz, IDLE_RATE_HZ)), self._clock.now_s())
                await asyncio.sleep(next_s - self._clock.now_s())
        finally:
            self._remove_reader(rate_hz, hold)

    def _format_since(self, event_number: int, hold: PeakHold) -> str:
        """Format the events after a number. That of the display has the peaks since the reader's last one."""
        texts = {kind: text for kind, (number, text) in self._latest.items() if number > event_number}
        if "display" in texts and self._display is not None:
            display = hold.release(self._display)
            if display is not self._display:
                texts["display"] = _format_event("display", display.model_dump_json())
        return "".join(texts.values())

    @property
    def _newest_batch(self) -> int:
        """Number of the newest kept batch."""
        return self._batches[-1].number if self._batches else 0

    def _add_reader(self, rate_hz: float, hold: PeakHold) -> None:
        self._rates_hz.append(rate_hz)
        self._holds.append(hold)
        self.on_readers(*self.readers)

    def _remove_reader(self, rate_hz: float, hold: PeakHold) -> None:
        self._rates_hz.remove(rate_hz)
        self._holds.remove(hold)
        if not self._rates_hz:  # the planner repeats its batches for the next reader; its events will be newer
            self._batches.clear()
            self._latest = {kind: self._latest[kind] for kind in ("state", "fault") if kind in self._latest}
        self.on_readers(*self.readers)

    def _format_pulses_since(self, number: int) -> str:
        """Format the event of all batches after a number, a `PulsesEvent`, or of the newest if those are too many."""
        texts: dict[str, list[str]] = {"planned": [], "executed": []}
        pulses = 0
        for batch in reversed(self._batches):
            pulses += batch.pulse_count
            if batch.number <= number or pulses > PULSES_MAX:
                break
            texts[batch.kind].insert(0, batch.text)
        lists = ",".join(f'"{kind}":[{",".join(batches)}]' for kind, batches in texts.items())
        return _format_event("pulses", f'{{"board_s":{self._board_s:.6f},{lists}}}')


def _format_event(kind: str, text: str) -> str:
    return f"event: {kind}\ndata: {text}\n\n"
