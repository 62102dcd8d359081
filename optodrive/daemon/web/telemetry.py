"""What happens now, as server-sent events: state, display, pulses, budget, fault (docs/page.md).

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
from optodrive.daemon.engine.display_snapshot import Executed, LiveHeat
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.progress import ClockMoved, joined
from optodrive.physics.nominal_display import Heights
from optodrive.planning.limiter.usage import Usage

RATE_HZ = 30.0
IDLE_HZ = 20.0
READERS_MAX = 64
FRESH_S = 0.012
"""A look this old still serves a reader."""
STATE_EVERY_S, BUDGET_EVERY_S, COLD_EVERY_S, PULSES_EVERY_S = 0.5, 0.25, 1.0, 0.08
DRAIN_EVERY_S = 1.0
WARM_M, WARM_K = 5e-8, 0.1
"""A pixel above either is warm."""
AHEAD_S = 1.0
"""Planned pulses are told so long before they are due."""
KEPT = 300
"""Batches of pulses kept for whoever comes late."""
PULSES_MAX = 3000
HEIGHT_M, WARMTH_K = 1e-7, 0.1
"""Units of what `display` holds."""


class EventStream(StreamingResponse):
    """Server-sent events."""

    media_type = "text/event-stream"

    def __init__(self, events: AsyncIterator[bytes]) -> None:
        super().__init__(events, headers={"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"})


class _Batch(NamedTuple):
    number: int
    pulses: int
    kind: str
    text: str


class Telemetry:
    """Events for any number of readers, in the web server's thread and one of its own."""

    def __init__(self, engine: Engine, clock: Clock | None = None) -> None:
        self._engine = engine
        self._clock = clock or MonotonicClock()
        self._live = LiveHeat(engine.display)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="telemetry")
        self._look: asyncio.Task[None] | None = None
        self._looked_s = -1.0
        self._readers = 0
        self._closed = False
        self._latest: dict[str, tuple[int, str]] = {}
        self._due_s: dict[str, float] = {}
        self._batches: deque[_Batch] = deque(maxlen=KEPT)
        self._number = 0
        self._announced: dict[str, int] = {}
        self._state_key: object = None
        self._fault_key: object = None
        self._board_s = (0.0, 0.0)
        self._warm = self._coming = False

    def close(self) -> None:
        """End every reader soon."""
        self._closed = True

    @asynccontextmanager
    async def while_served(self, _app: object) -> AsyncIterator[None]:
        """Take over what was executed also while nobody looks, as long as the server runs."""
        follower = asyncio.get_running_loop().create_task(self._follow())
        try:
            yield
        finally:
            self.close()
            follower.cancel()

    async def _follow(self) -> None:
        while not self._closed:
            await self._fresh(DRAIN_EVERY_S)
            await asyncio.sleep(DRAIN_EVERY_S)

    def check_room(self) -> None:
        """NotReadyError where there are too many readers."""
        if self._readers >= READERS_MAX:
            raise NotReadyError(f"{READERS_MAX} readers follow the telemetry already")

    async def events(self, rate_hz: float = RATE_HZ) -> AsyncIterator[bytes]:
        """Events for one reader: whatever is new each 1 / rate_hz, until it leaves."""
        seen, batch = dict[str, int](), 0
        due_s, pulses_s = self._clock.now_s(), 0.0
        self._readers += 1
        try:
            while not self._closed:
                await self._fresh(FRESH_S)
                text = "".join(event for kind, (number, event) in self._latest.items() if seen.get(kind) != number)
                seen = {kind: number for kind, (number, _) in self._latest.items()}
                now_s = self._clock.now_s()
                if self._number > batch and now_s >= pulses_s:
                    text += self._pulses_since(batch)
                    batch, pulses_s = self._number, now_s + PULSES_EVERY_S
                if text:
                    yield text.encode()
                busy = self._warm or self._coming or self._number > batch
                due_s = max(due_s + 1.0 / (rate_hz if busy else min(rate_hz, IDLE_HZ)), self._clock.now_s())
                await asyncio.sleep(due_s - self._clock.now_s())
        finally:
            self._readers -= 1

    async def _fresh(self, age_s: float) -> None:
        """Return when the last look is no older than age_s; readers that come at one time share it."""
        if self._look is None or (self._look.done() and self._clock.now_s() - self._looked_s > age_s):
            loop = asyncio.get_running_loop()
            self._look = loop.create_task(_done(loop.run_in_executor(self._thread, self._take_a_look)))
        await asyncio.shield(self._look)

    # --- in the thread of its own -------------------------------------------------------------------------------

    def _take_a_look(self) -> None:
        now_s = self._clock.now_s()
        board_s = self._board_time(now_s)
        self._take_executed()
        self._announce(board_s)
        self._tell_state(now_s)
        self._tell_display(now_s, board_s)
        if self._is_due("budget", now_s, BUDGET_EVERY_S):
            self._tell("budget", {"board_s": board_s, "caps": self._caps(self._live.usage(board_s))})
        self._looked_s = self._clock.now_s()

    def _board_time(self, now_s: float) -> float:
        """The board's time; reckoned on while there is no link."""
        if self._engine.linked:
            self._board_s = now_s, self._engine.board_s()
        return self._board_s[1] + now_s - self._board_s[0]

    def _is_due(self, kind: str, now_s: float, every_s: float) -> bool:
        due = now_s >= self._due_s.get(kind, now_s)
        if due:
            self._due_s[kind] = now_s + every_s
        return due

    def _tell(self, kind: str, data: dict[str, Any]) -> None:
        number = self._latest.get(kind, (0, ""))[0] + 1
        self._latest[kind] = number, f"event: {kind}\ndata: {json.dumps(data, separators=(',', ':'))}\n\n"

    def _take_executed(self) -> None:
        for told in joined(self._engine.take_told()):
            if isinstance(told, ClockMoved):
                self._live.clock_moved(told.delay_s)
                continue
            executed = Executed.of(told, self._engine.scale)
            if len(executed.row):
                self._live.take(executed)
                timed = (executed.start_s, executed.width_s, executed.power_w)
                self._add_batch("executed", executed.record, executed.row, *timed)

    def _announce(self, board_s: float) -> None:
        """Tell of planned pulses that come soon."""
        records = self._engine.coming()
        self._coming = bool(records)
        self._announced = {record.plan_id: self._announced.get(record.plan_id, 0) for record in records}
        for record in records:
            plan, begin = record.prepared.plan, self._announced[record.plan_id]
            end = int(np.searchsorted(plan.start_s, board_s + AHEAD_S - record.start_s))
            if end > begin:
                row = np.arange(begin, end)
                timed = (plan.start_s[begin:end] + record.start_s, plan.width_s[begin:end], plan.power_w[begin:end])
                self._add_batch("planned", record, row, *timed)
                self._announced[record.plan_id] = end

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
        plan = record.prepared.plan
        columns = {
            "plan": record.plan_id,
            "name": record.name,
            "row": row.tolist(),
            "pixel": plan.pixel[row].tolist(),
            "start_s": _rounded(start_s, 6),
            "width_s": _rounded(width_s, 6),
            "power_w": _rounded(power_w, 4),
            "trimmed_j": _rounded(plan.trimmed_j[row], 6),
            "reason": [str(reason) for reason in plan.reason[row]],
        }
        self._number += 1
        self._batches.append(_Batch(self._number, len(row), kind, json.dumps(columns, separators=(",", ":"))))

    def _pulses_since(self, number: int) -> str:
        """One event with what a reader has not had, the newest where that is too much."""
        parts: dict[str, list[str]] = {"planned": [], "executed": []}
        pulses = 0
        for batch in reversed(self._batches):
            pulses += batch.pulses
            if batch.number <= number or pulses > 2 * PULSES_MAX:
                break
            parts[batch.kind].insert(0, batch.text)
        lists = ",".join(f'"{kind}":[{",".join(texts)}]' for kind, texts in parts.items())
        return f'event: pulses\ndata: {{"board_s":{self._board_s[1]:.6f},{lists}}}\n\n'

    def _tell_state(self, now_s: float) -> None:
        state = self._engine.snapshot()
        board, queue = state["board"], state["queue"]
        plans = tuple((plan["plan"], plan["status"]) for plan in queue["plans"])
        key = (board["state"], board["fault"], board["inputs"], state["link"]["state"], state["planner"]["busy"], plans)
        changed, due = key != self._state_key, self._is_due("state", now_s, STATE_EVERY_S)
        if changed or due:
            self._state_key = key
            self._tell("state", state)
        trouble = {"fault": board["fault"], "hint": board["hint"], "link_error": state["link"]["error"]}
        if tuple(trouble.values()) != self._fault_key:
            self._fault_key = tuple(trouble.values())
            self._tell("fault", {"board": board["state"], "link": state["link"]["state"], **trouble})

    def _tell_display(self, now_s: float, board_s: float) -> None:
        seen = self._live.at(board_s)
        was_warm = self._warm
        self._warm = bool(seen.displacement_m.max() > WARM_M or np.abs(seen.absorber_k).max() > WARM_K)
        if self._warm or was_warm or self._is_due("display", now_s, COLD_EVERY_S):
            self._tell("display", {"board_s": round(board_s, 6), "warm": self._warm, **self._packed(seen)})

    def _packed(self, seen: Heights) -> dict[str, str]:
        celsius = self._engine.display.config.ambient_c + seen.absorber_k
        return {
            "height": _base64(seen.displacement_m / HEIGHT_M),
            "absorber": _base64(celsius / WARMTH_K),
        }

    def _caps(self, used: tuple[Usage, ...]) -> list[dict[str, Any]]:
        """Caps as people read them: temperatures in °C, energy in J, power in W, acceleration in rad/s² rms."""
        limits = self._engine.display.config.limits
        celsius = {
            "absorber_temperature": limits.absorber_max_c,
            "wall_temperature": limits.wall_max_c,
            "touch_temperature": limits.touch_max_c,
        }
        units = {"spot_energy": "J", "galvo_acceleration": "rad/s²"}
        caps = []
        for item in used:
            if not isfinite(item.limit):
                continue
            value, limit, unit = item.used, item.limit, units.get(item.cap, "W")
            if item.cap in celsius:
                value, limit, unit = celsius[item.cap] - (item.limit - item.used), celsius[item.cap], "°C"
            elif item.cap == "galvo_acceleration":
                value, limit = sqrt(value), sqrt(limit)
            share = item.used / item.limit
            caps.append(
                {
                    "cap": item.cap,
                    "share": round(share, 4),
                    "value": float(f"{value:.5g}"),
                    "limit": float(f"{limit:.5g}"),
                    "unit": unit,
                    "pixel": item.pixel,
                }
            )
        return caps


async def _done(work: "asyncio.Future[None]") -> None:
    await work


def _base64(values: FloatArray) -> str:
    return b64encode(np.clip(np.rint(values), 0, 65535).astype("<u2").tobytes()).decode()


def _rounded(values: FloatArray, digits: int) -> list[float]:
    rounded: list[float] = np.round(values, digits).tolist()
    return rounded
