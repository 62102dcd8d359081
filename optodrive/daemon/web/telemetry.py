"""What happens now, as server-sent events: state, display, pulses, budget, fault (docs/how-to/operate-the-page.md).

Readers pull: a look is made when one of them is due, in a thread of its own, and shared by all that ask at the time. A
reader that is slow is handed the newest when it is ready for more; nothing waits for it.
"""

import asyncio
import json
from base64 import b64encode
from collections import deque
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from math import isfinite, sqrt
from typing import Any, NamedTuple

import numpy as np
from starlette.responses import StreamingResponse

from optodrive.core.clock import Clock, MonotonicClock
from optodrive.core.errors import NotReadyError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.daemon.engine.display_snapshot import ExecutedBatch, LiveThermalState
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.progress import ClockShift, merge_events
from optodrive.physics.nominal_display import DisplayState
from optodrive.planning.limiter.usage import Usage

DEFAULT_RATE_HZ = 30.0
IDLE_RATE_HZ = 20.0
READERS_MAX = 64
SNAPSHOT_MAX_AGE_S = 0.012
"""A look this old still serves a reader."""
STATE_PERIOD_S, BUDGET_PERIOD_S, COLD_DISPLAY_PERIOD_S, PULSES_PERIOD_S = 0.5, 0.25, 1.0, 0.08
DRAIN_PERIOD_S = 1.0
WARM_DISPLACEMENT_M, WARM_RISE_K = 5e-8, 0.1
"""A pixel above either is warm."""
ANNOUNCE_LEAD_S = 1.0
"""Planned pulses are told so long before they are due."""
BATCHES_MAX = 300
"""Batches of pulses kept for whoever comes late."""
PULSES_MAX = 3000
HEIGHT_UNIT_M, TEMPERATURE_UNIT_K = 1e-7, 0.1
"""Units of what `display` holds."""


class EventStream(StreamingResponse):
    """Server-sent events."""

    media_type = "text/event-stream"

    def __init__(self, events: AsyncIterator[bytes]) -> None:
        super().__init__(events, headers={"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"})


class _Batch(NamedTuple):
    number: int
    pulse_count: int
    kind: str
    text: str


class Telemetry:
    """Events for any number of readers, in the web server's thread and one of its own."""

    def __init__(self, engine: Engine, clock: Clock | None = None) -> None:
        self._engine = engine
        self._clock = clock or MonotonicClock()
        self._executed_state = LiveThermalState(engine.display)
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="telemetry")
        self._refresh_task: asyncio.Task[None] | None = None
        self._refreshed_s = -1.0
        self._readers = 0
        self._closed = False
        self._latest: dict[str, tuple[int, str]] = {}
        self._due_s: dict[str, float] = {}
        self._batches: deque[_Batch] = deque(maxlen=BATCHES_MAX)
        self._batch_number = 0
        self._announced_rows: dict[str, int] = {}
        self._state_key: object = None
        self._fault_key: object = None
        self._board_clock_reference = (0.0, 0.0)
        self._is_warm = self._has_upcoming = False

    def close(self) -> None:
        """End every reader soon."""
        self._closed = True

    @asynccontextmanager
    async def lifespan(self, _app: object) -> AsyncIterator[None]:
        """Take over what was executed also while nobody looks, as long as the server runs."""
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
        """NotReadyError where there are too many readers."""
        if self._readers >= READERS_MAX:
            raise NotReadyError(f"{READERS_MAX} readers follow the telemetry already")

    async def stream_events(self, rate_hz: float = DEFAULT_RATE_HZ) -> AsyncIterator[bytes]:
        """Events for one reader: whatever is new each 1 / rate_hz, until it leaves."""
        sent_numbers, batch = dict[str, int](), 0
        due_s, pulses_s = self._clock.now_s(), 0.0
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
                due_s = max(due_s + 1.0 / (rate_hz if busy else min(rate_hz, IDLE_RATE_HZ)), self._clock.now_s())
                await asyncio.sleep(due_s - self._clock.now_s())
        finally:
            self._readers -= 1

    async def _refresh(self, max_age_s: float) -> None:
        """Return when the last look is no older than age_s; readers that come at one time share it."""
        if self._refresh_task is None or (
            self._refresh_task.done() and self._clock.now_s() - self._refreshed_s > max_age_s
        ):
            loop = asyncio.get_running_loop()
            self._refresh_task = loop.create_task(_wait_for(loop.run_in_executor(self._executor, self._publish_all)))
        await asyncio.shield(self._refresh_task)

    # --- in the thread of its own -------------------------------------------------------------------------------

    def _publish_all(self) -> None:
        now_s = self._clock.now_s()
        board_s = self._estimate_board_s(now_s)
        self._collect_executed()
        self._announce_planned(board_s)
        self._publish_state(now_s)
        self._publish_display(now_s, board_s)
        if self._is_due("budget", now_s, BUDGET_PERIOD_S):
            self._publish(
                "budget", {"board_s": board_s, "caps": self._describe_caps(self._executed_state.compute_usage(board_s))}
            )
        self._refreshed_s = self._clock.now_s()

    def _estimate_board_s(self, now_s: float) -> float:
        """The board's time; reckoned on while there is no link."""
        if self._engine.is_linked:
            self._board_clock_reference = now_s, self._engine.board_s()
        return self._board_clock_reference[1] + now_s - self._board_clock_reference[0]

    def _is_due(self, kind: str, now_s: float, period_s: float) -> bool:
        due = now_s >= self._due_s.get(kind, now_s)
        if due:
            self._due_s[kind] = now_s + period_s
        return due

    def _publish(self, kind: str, data: dict[str, Any]) -> None:
        number = self._latest.get(kind, (0, ""))[0] + 1
        self._latest[kind] = number, f"event: {kind}\ndata: {json.dumps(data, separators=(',', ':'))}\n\n"

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
        """Tell of planned pulses that come soon."""
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
        row, start_s, width_s, power_w = (
            row[-PULSES_MAX:],
            start_s[-PULSES_MAX:],
            width_s[-PULSES_MAX:],
            power_w[-PULSES_MAX:],
        )
        plan = record.planned.plan
        columns = {
            "plan": record.plan_id,
            "name": record.name,
            "row": row.tolist(),
            "pixel": plan.pixel[row].tolist(),
            "start_s": _round_values(start_s, 6),
            "width_s": _round_values(width_s, 6),
            "power_w": _round_values(power_w, 4),
            "trimmed_j": _round_values(plan.trimmed_j[row], 6),
            "reason": [str(reason) for reason in plan.reason[row]],
        }
        self._batch_number += 1
        self._batches.append(_Batch(self._batch_number, len(row), kind, json.dumps(columns, separators=(",", ":"))))

    def _format_pulses_since(self, number: int) -> str:
        """One event with what a reader has not had, the newest where that is too much."""
        parts: dict[str, list[str]] = {"planned": [], "executed": []}
        pulses = 0
        for batch in reversed(self._batches):
            pulses += batch.pulse_count
            if batch.number <= number or pulses > 2 * PULSES_MAX:
                break
            parts[batch.kind].insert(0, batch.text)
        lists = ",".join(f'"{kind}":[{",".join(texts)}]' for kind, texts in parts.items())
        return f'event: pulses\ndata: {{"board_s":{self._board_clock_reference[1]:.6f},{lists}}}\n\n'

    def _publish_state(self, now_s: float) -> None:
        state = self._engine.snapshot()
        board, queue = state["board"], state["queue"]
        plans = tuple((plan["plan"], plan["status"]) for plan in queue["plans"])
        key = (board["state"], board["fault"], board["inputs"], state["link"]["state"], state["planner"]["busy"], plans)
        changed, due = key != self._state_key, self._is_due("state", now_s, STATE_PERIOD_S)
        if changed or due:
            self._state_key = key
            self._publish("state", state)
        fault = {"fault": board["fault"], "hint": board["hint"], "link_error": state["link"]["error"]}
        if tuple(fault.values()) != self._fault_key:
            self._fault_key = tuple(fault.values())
            self._publish("fault", {"board": board["state"], "link": state["link"]["state"], **fault})

    def _publish_display(self, now_s: float, board_s: float) -> None:
        pixel_state = self._executed_state.state_at(board_s)
        was_warm = self._is_warm
        self._is_warm = bool(
            pixel_state.displacement_m.max() > WARM_DISPLACEMENT_M or np.abs(pixel_state.absorber_k).max() > WARM_RISE_K
        )
        if self._is_warm or was_warm or self._is_due("display", now_s, COLD_DISPLAY_PERIOD_S):
            self._publish(
                "display", {"board_s": round(board_s, 6), "warm": self._is_warm, **self._encode_display(pixel_state)}
            )

    def _encode_display(self, pixel_state: DisplayState) -> dict[str, str]:
        absorber_c = self._engine.display.config.ambient_c + pixel_state.absorber_k
        return {
            "height": _encode_base64(pixel_state.displacement_m / HEIGHT_UNIT_M),
            "absorber": _encode_base64(absorber_c / TEMPERATURE_UNIT_K),
        }

    def _describe_caps(self, usages: tuple[Usage, ...]) -> list[dict[str, Any]]:
        """Caps as people read them: temperatures in °C, energy in J, power in W, acceleration in rad/s² rms."""
        limits = self._engine.display.config.limits
        max_c = {
            "absorber_temperature": limits.absorber_max_c,
            "wall_temperature": limits.wall_max_c,
            "touch_temperature": limits.touch_max_c,
        }
        units = {"spot_energy": "J", "galvo_acceleration": "rad/s²"}
        caps = []
        for usage in usages:
            if not isfinite(usage.limit):
                continue
            value, limit, unit = usage.used, usage.limit, units.get(usage.cap, "W")
            if usage.cap in max_c:
                value, limit, unit = max_c[usage.cap] - (usage.limit - usage.used), max_c[usage.cap], "°C"
            elif usage.cap == "galvo_acceleration":
                value, limit = sqrt(value), sqrt(limit)
            fraction = usage.used / usage.limit
            caps.append(
                {
                    "cap": usage.cap,
                    "share": round(fraction, 4),
                    "value": float(f"{value:.5g}"),
                    "limit": float(f"{limit:.5g}"),
                    "unit": unit,
                    "pixel": usage.pixel,
                }
            )
        return caps


async def _wait_for(future: "asyncio.Future[None]") -> None:
    await future


def _encode_base64(values: FloatArray) -> str:
    return b64encode(np.clip(np.rint(values), 0, 65535).astype("<u2").tobytes()).decode()


def _round_values(values: FloatArray, digits: int) -> list[float]:
    rounded: list[float] = np.round(values, digits).tolist()
    return rounded
