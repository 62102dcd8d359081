"""Telemetry as server-sent events: state, display, pulses, budget, fault.

Readers pull: when an event for one of them is due, a separate thread refreshes all events, and all readers of that time
share the result. A slow reader receives the newest events when it is ready; nothing waits for it.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from typing import NamedTuple

import numpy as np
from starlette.responses import StreamingResponse

from optodrive.core.clock import Clock, MonotonicClock
from optodrive.core.errors import NotReadyError
from optodrive.core.json_model import JsonModel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.daemon.one_process.display_snapshot import ExecutedBatch, LiveThermalState
from optodrive.daemon.one_process.engine import Engine
from optodrive.daemon.one_process.plan_record import PlanRecord
from optodrive.daemon.one_process.progress import ClockShift, merge_events
from optodrive.daemon.responses.telemetry import BudgetEvent, FaultEvent
from optodrive.daemon.web.telemetry_events import build_display_event, build_pulse_batch, describe_caps

DEFAULT_RATE_HZ = 30.0
IDLE_RATE_HZ = 20.0
READERS_MAX = 64
SNAPSHOT_MAX_AGE_S = 0.012
"""Events up to this age are sent without a refresh."""
STATE_PERIOD_S, BUDGET_PERIOD_S, COLD_DISPLAY_PERIOD_S, PULSES_PERIOD_S = 0.5, 0.25, 1.0, 0.08
DRAIN_PERIOD_S = 1.0
WARM_DISPLACEMENT_M, WARM_RISE_K = 5e-8, 0.1
"""A pixel above either threshold is warm."""
ANNOUNCE_LEAD_S = 1.0
"""Planned pulses are published this long before they start."""
BATCHES_MAX = 300
"""Batches of pulses that are kept for slow readers."""
PULSES_MAX = 3000


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


class Telemetry:
    """Events for up to READERS_MAX readers, in the web server's thread and one of its own."""

    def __init__(self, engine: Engine, clock: Clock | None = None) -> None:
        self._engine = engine
        self._config = engine.display.config
        self._clock = clock or MonotonicClock()
        self._executed_state = LiveThermalState(engine.display)
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="telemetry")
        self._refresh_task: asyncio.Task[None] | None = None
        self._refreshed_s = -1.0
        self._readers = 0
        self._closed = False
        self._latest: dict[str, tuple[int, str]] = {}
        self._next_s: dict[str, float] = {}
        self._batches: deque[_Batch] = deque(maxlen=BATCHES_MAX)
        self._batch_number = 0
        self._announced_rows: dict[str, int] = {}
        self._state_key: object = None
        self._fault_key: object = None
        self._board_clock_reference = (0.0, 0.0)
        self._is_warm = self._has_upcoming = False

    def close(self) -> None:
        """End all event streams at their next event."""
        self._closed = True

    @asynccontextmanager
    async def lifespan(self, _app: object) -> AsyncIterator[None]:
        """Collect executed pulses while the server runs, also without readers."""
        drain_task = asyncio.get_running_loop().create_task(self._drain_periodically())
        try:
            yield
        finally:
            self.close()
            drain_task.cancel()

    async def _drain_periodically(self) -> None:
        while not self._closed:
            await self._refresh(DRAIN_PERIOD_S)
            await asyncio.sleep(DRAIN_PERIOD_S)

    def require_capacity(self) -> None:
        """Raise NotReadyError if there are too many readers."""
        if self._readers >= READERS_MAX:
            raise NotReadyError(f"{READERS_MAX} clients read the telemetry already")

    async def stream_events(self, rate_hz: float = DEFAULT_RATE_HZ) -> AsyncIterator[bytes]:
        """Yield the new events for one reader every 1 / rate_hz seconds, until it disconnects."""
        sent_numbers, batch = dict[str, int](), 0
        next_s, pulses_s = self._clock.now_s(), 0.0
        self._readers += 1
        try:
            while not self._closed:
                await self._refresh(SNAPSHOT_MAX_AGE_S)
                text = "".join(
                    event for kind, (number, event) in self._latest.items() if sent_numbers.get(kind) != number
                )
                sent_numbers = {kind: number for kind, (number, _) in self._latest.items()}
                now_s = self._clock.now_s()
                if self._batch_number > batch and now_s >= pulses_s:
                    text += self._format_pulses_since(batch)
                    batch, pulses_s = self._batch_number, now_s + PULSES_PERIOD_S
                if text:
                    yield text.encode()
                busy = self._is_warm or self._has_upcoming or self._batch_number > batch
                next_s = max(next_s + 1.0 / (rate_hz if busy else min(rate_hz, IDLE_RATE_HZ)), self._clock.now_s())
                await asyncio.sleep(next_s - self._clock.now_s())
        finally:
            self._readers -= 1

    async def _refresh(self, max_age_s: float) -> None:
        """Return once the events are no older than max_age_s; concurrent readers share one refresh."""
        if self._refresh_task is None or (
            self._refresh_task.done() and self._clock.now_s() - self._refreshed_s > max_age_s
        ):
            loop = asyncio.get_running_loop()
            self._refresh_task = loop.create_task(_wait_for(loop.run_in_executor(self._executor, self._publish_all)))
        await asyncio.shield(self._refresh_task)

    # --- in the telemetry thread --------------------------------------------------------------------------------

    def _publish_all(self) -> None:
        now_s = self._clock.now_s()
        board_s = self._estimate_board_s(now_s)
        self._collect_executed()
        self._announce_planned(board_s)
        self._publish_state(now_s)
        self._publish_display(now_s, board_s)
        if self._is_due("budget", now_s, BUDGET_PERIOD_S):
            usages = self._executed_state.compute_usage(board_s)
            self._publish("budget", BudgetEvent(board_s=board_s, caps=describe_caps(usages, self._config.limits)))
        self._refreshed_s = self._clock.now_s()

    def _estimate_board_s(self, now_s: float) -> float:
        """Estimate the board's time; it is extrapolated while there is no link."""
        if self._engine.is_linked:
            self._board_clock_reference = now_s, self._engine.board_s()
        return self._board_clock_reference[1] + now_s - self._board_clock_reference[0]

    def _is_due(self, kind: str, now_s: float, period_s: float) -> bool:
        due = now_s >= self._next_s.get(kind, now_s)
        if due:
            self._next_s[kind] = now_s + period_s
        return due

    def _publish(self, kind: str, event: JsonModel) -> None:
        number = self._latest.get(kind, (0, ""))[0] + 1
        self._latest[kind] = number, _format_event(kind, event)

    def _collect_executed(self) -> None:
        for event in merge_events(self._engine.drain_events()):
            if isinstance(event, ClockShift):
                self._executed_state.shift_clock(event.delay_s)
                continue
            executed = ExecutedBatch.from_progress(event, self._engine.scale)
            if len(executed.row):
                self._executed_state.apply(executed)
                columns = (executed.start_s, executed.width_s, executed.power_w)
                self._add_batch("executed", executed.record, executed.row, *columns)

    def _announce_planned(self, board_s: float) -> None:
        """Publish the planned pulses that start soon."""
        records = self._engine.list_upcoming()
        self._has_upcoming = bool(records)
        self._announced_rows = {record.plan_id: self._announced_rows.get(record.plan_id, 0) for record in records}
        for record in records:
            plan, begin = record.planned.plan, self._announced_rows[record.plan_id]
            end = int(np.searchsorted(plan.start_s, board_s + ANNOUNCE_LEAD_S - record.start_s))
            if end > begin:
                row = np.arange(begin, end)
                columns = (plan.start_s[begin:end] + record.start_s, plan.width_s[begin:end], plan.power_w[begin:end])
                self._add_batch("planned", record, row, *columns)
                self._announced_rows[record.plan_id] = end

    def _add_batch(
        self,
        kind: str,
        record: PlanRecord,
        row: IntArray,
        start_s: FloatArray,
        width_s: FloatArray,
        power_w: FloatArray,
    ) -> None:
        newest = slice(-PULSES_MAX, None)
        row = row[newest]
        batch = build_pulse_batch(record, row, start_s[newest], width_s[newest], power_w[newest])
        self._batch_number += 1
        self._batches.append(_Batch(self._batch_number, len(row), kind, batch.model_dump_json()))

    def _format_pulses_since(self, number: int) -> str:
        """Format the event of all batches after a number; if those are too many, of the newest.

        Every batch is encoded once, in this class's thread; the readers' events, which the web server's loop formats,
        only join the texts. The result is a `PulsesEvent`.
        """
        texts: dict[str, list[str]] = {"planned": [], "executed": []}
        pulses = 0
        for batch in reversed(self._batches):
            pulses += batch.pulse_count
            if batch.number <= number or pulses > 2 * PULSES_MAX:
                break
            texts[batch.kind].insert(0, batch.text)
        lists = ",".join(f'"{kind}":[{",".join(batches)}]' for kind, batches in texts.items())
        return f'event: pulses\ndata: {{"board_s":{self._board_clock_reference[1]:.6f},{lists}}}\n\n'

    def _publish_state(self, now_s: float) -> None:
        state = self._engine.snapshot()
        board, link = state.board, state.link
        plans = tuple((plan.plan, plan.status) for plan in state.queue.plans)
        key = (board.state, board.fault, board.inputs, link.state, state.planner.busy, plans)
        changed, due = key != self._state_key, self._is_due("state", now_s, STATE_PERIOD_S)
        if changed or due:
            self._state_key = key
            self._publish("state", state)
        fault_key = board.fault, board.hint, link.error
        if fault_key != self._fault_key:
            self._fault_key = fault_key
            fault, hint, link_error = fault_key
            event = FaultEvent(board=board.state, link=link.state, fault=fault, hint=hint, link_error=link_error)
            self._publish("fault", event)

    def _publish_display(self, now_s: float, board_s: float) -> None:
        pixel_state = self._executed_state.state_at(board_s)
        was_warm = self._is_warm
        self._is_warm = bool(
            pixel_state.displacement_m.max() > WARM_DISPLACEMENT_M or np.abs(pixel_state.absorber_k).max() > WARM_RISE_K
        )
        if self._is_warm or was_warm or self._is_due("display", now_s, COLD_DISPLAY_PERIOD_S):
            self._publish("display", build_display_event(board_s, self._is_warm, pixel_state, self._config.ambient_c))


async def _wait_for(future: "asyncio.Future[None]") -> None:
    await future


def _format_event(kind: str, event: JsonModel) -> str:
    return f"event: {kind}\ndata: {event.model_dump_json()}\n\n"
