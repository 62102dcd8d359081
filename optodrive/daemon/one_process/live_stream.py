"""Streamed frames over a WebSocket: the newest frame wins, and the client gets the result of every frame."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial

from starlette.websockets import WebSocket, WebSocketDisconnect

from optodrive.core.errors import OptodriveError
from optodrive.core.types.policy import Policy
from optodrive.core.types.stimuli import FrameSequence
from optodrive.daemon.one_process.engine import Engine
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.responses.problem import Problem
from optodrive.daemon.responses.stream import FrameResult
from optodrive.planning.stimuli.streamed_frame import parse_live_frame

OUTBOX_MAX = 1000
"""A client with this number of unread results is disconnected."""
CLOSE_SLOW_READER = 1013
ProblemFormatter = Callable[[OptodriveError], Problem]


class LiveStream:
    """Stream of one client. A new frame replaces one that waits for the planner, and all unsent pulses."""

    def __init__(
        self, engine: Engine, socket: WebSocket, policy: Policy, caller: str, to_problem: ProblemFormatter
    ) -> None:
        self._engine = engine
        self._caller = caller
        self._socket = socket
        self._policy = policy
        self._to_problem = to_problem
        self._pixels = len(engine.display.layout)
        self._next_number = 0
        self._pending: tuple[int, FrameSequence, float] | None = None
        self._arrived = asyncio.Event()
        self._outbox: asyncio.Queue[FrameResult] = asyncio.Queue(OUTBOX_MAX)
        self._watchers: set[asyncio.Task[None]] = set()
        self._last_end_future: Future[None] | None = None

    async def run(self) -> None:
        """Serve until the client disconnects. Then drop the unsent pulses of the last frame."""
        await self._socket.accept()
        tasks = [asyncio.create_task(work()) for work in (self._read, self._plan, self._write)]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            if self._last_end_future is not None and not self._last_end_future.done():
                self._engine.end_stream(
                    self._caller
                )  # first, because this coroutine may be cancelled at its next await
            for task in (*tasks, *self._watchers):
                task.cancel()
            await asyncio.gather(*tasks, *self._watchers, return_exceptions=True)

    async def _read(self) -> None:
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            data: str | bytes = message.get("text") or message.get("bytes") or b""
            arrived_s = self._engine.board_s()
            try:
                number, sequence = parse_live_frame(data, self._next_number, self._pixels)
            except OptodriveError as error:
                self._publish(FrameResult(frame=None, status="refused", problem=self._to_problem(error)))
                continue
            if self._pending is not None:
                self._publish(FrameResult(frame=self._pending[0], status="superseded", superseded_by=number))
            self._pending, self._next_number = (number, sequence, arrived_s), number + 1
            self._arrived.set()

    async def _plan(self) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            assert self._pending is not None  # noqa: S101 - set before the event
            (number, sequence, arrived_s), self._pending = self._pending, None
            future = self._engine.submit(
                partial(_return_sequence, sequence),
                f"frame {number}",
                policy=self._policy,
                streamed=True,
                arrived_s=arrived_s,
                caller=self._caller,
            )
            try:
                report = await asyncio.wrap_future(future)
            except OptodriveError as error:
                self._publish(FrameResult(frame=number, status="refused", problem=self._to_problem(error)))
                continue
            self._last_end_future = self._engine.get_end_future(report.plan)
            self._publish(_report_planned(number, report))
            watcher = asyncio.create_task(self._watch(number, report.plan, self._last_end_future))
            self._watchers.add(watcher)
            watcher.add_done_callback(self._watchers.discard)

    async def _watch(self, number: int, plan_id: str, end_future: "Future[None]") -> None:
        await asyncio.wrap_future(end_future)
        self._publish(_report_ended(number, self._engine.get_plan(plan_id, pulses=False)))

    def _publish(self, result: FrameResult) -> None:
        try:
            self._outbox.put_nowait(result)
        except asyncio.QueueFull:
            self._arrived.clear()
            raise WebSocketDisconnect(CLOSE_SLOW_READER) from None

    async def _write(self) -> None:
        while True:
            await self._socket.send_text((await self._outbox.get()).model_dump_json())


def _return_sequence(sequence: FrameSequence) -> FrameSequence:
    return sequence


def _report_planned(number: int, report: PlanReport) -> FrameResult:
    return FrameResult(
        frame=number,
        status="planned",
        plan=report.plan,
        pulses=report.planned,
        skipped=len(report.summary.skipped),
        trimmed=report.summary.trimmed.pulses,
        starts_in_s=report.starts_in_s,
        duration_s=report.summary.duration_s,
        latency=report.latency,
    )


def _report_ended(number: int, report: PlanReport) -> FrameResult:
    return FrameResult(
        frame=number,
        status=report.status,
        plan=report.plan,
        error=report.error,
        planned=report.planned,
        executed=report.executed,
        dropped=report.dropped,
        simulated_max_um=report.simulated_max_um,
        latency=report.latency,
    )
