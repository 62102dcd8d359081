"""Streamed frames over a WebSocket: the newest frame wins, and the client gets the result of every frame."""

import asyncio
import time
from math import inf
from typing import NamedTuple

from starlette.websockets import WebSocket, WebSocketDisconnect

from optodrive.core.errors import BusyError, OptodriveError
from optodrive.core.types.push_options import Policy
from optodrive.daemon.api.daemon_client import DaemonClient
from optodrive.daemon.api.host_check import select_subprotocol
from optodrive.daemon.api.request_limits import ARRIVED_S, EARLIEST_S
from optodrive.daemon.push import Push
from optodrive.daemon.responses.messages import FrameResult, RefreshReport
from optodrive.daemon.responses.plan import PlanReport, PlanStatus
from optodrive.daemon.responses.problem import Problem, build_error_problem
from optodrive.planning.stimuli.frame_json import parse_live_frame
from optodrive.planning.stimuli.sequence_file import encode_sequence

OUTBOX_MAX = 1000
"""A client with this number of unread results is disconnected."""
CLOSE_SLOW_READER = 1013
FRAME_AGE_MAX_S = 2.0
"""Longest time for which a frame may have waited in the socket: a backlog would light after its client has stopped."""


class Frame(NamedTuple):
    """A frame that has arrived, with its encoded sequence."""

    number: int
    sequence: bytes
    arrived_s: float
    epoch: int


class LiveStream:
    """Stream of one client. A new frame replaces one that waits for the planner, and all unsent pulses.

    caller: name of the client's token
    """

    def __init__(self, daemon: DaemonClient, socket: WebSocket, policy: Policy, caller: str) -> None:
        self._daemon = daemon
        self._socket = socket
        self._policy = policy
        self._caller = caller
        self._pixels = len(daemon.display.layout)
        self._next_number = 0
        self._pending: Frame | None = None
        self._arrived = asyncio.Event()
        self._outbox: asyncio.Queue[FrameResult] = asyncio.Queue(OUTBOX_MAX)
        self._watchers: set[asyncio.Task[None]] = set()
        self._last_watcher: asyncio.Task[None] | None = None
        self._last_epoch = 0

    async def run(self) -> None:
        """Serve until the client disconnects. Then drop the unsent pulses of the last frame."""
        await self._socket.accept(select_subprotocol(self._socket.scope))
        tasks = [asyncio.create_task(work()) for work in (self._read, self._plan, self._write)]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            # A client that has gone draws nothing any more: what it left in the queue would light for nobody.
            if self._may_emit():
                # First, because this coroutine may be cancelled at its next await.
                self._daemon.planner.end_stream(self._last_epoch, self._caller)
            for task in (*tasks, *self._watchers):
                task.cancel()
            await asyncio.gather(*tasks, *self._watchers, return_exceptions=True)

    def _may_emit(self) -> bool:
        """Whether pulses of this stream may not have left yet."""
        return self._last_watcher is not None and not self._last_watcher.done()

    async def _read(self) -> None:
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            data: str | bytes = message.get("text") or message.get("bytes") or b""
            try:
                # By the earliest time at which it may have arrived: a doubt counts against the frame.
                self._require_recent(message[EARLIEST_S])
                # The epoch of the frame's arrival, not of now: a STOP that came behind it must end it.
                epoch = self._daemon.link.require_epoch_at(message[EARLIEST_S])
                number, sequence = parse_live_frame(data, self._next_number, self._pixels)
                frame = Frame(number, encode_sequence(sequence), message[ARRIVED_S], epoch)
            except OptodriveError as error:
                self._publish(FrameResult(frame=None, status="refused", problem=build_error_problem(error)))
                continue
            if self._pending is not None:
                self._publish(
                    FrameResult(frame=self._pending.number, status=PlanStatus.SUPERSEDED, superseded_by=number)
                )
            self._pending, self._next_number = frame, number + 1
            self._arrived.set()

    def _require_recent(self, earliest_s: float) -> None:
        """Raise BusyError for a frame that may have arrived earlier than permitted."""
        age_s = asyncio.get_running_loop().time() - earliest_s
        if age_s > FRAME_AGE_MAX_S:
            raise BusyError(f"the frame may have waited for {age_s:.3g} s, expected at most {FRAME_AGE_MAX_S:g} s")

    async def _plan(self) -> None:
        while True:
            frame = await self._take_frame()
            try:
                result = await self._daemon.planner.submit(frame.sequence, self._build_push(frame))
            except OptodriveError as error:
                self._refuse(frame, build_error_problem(error))
                continue
            if result.fields["status"] >= 400:
                self._refuse(frame, Problem.model_validate_json(result.payload))
                continue
            self._follow(frame, result.payload)

    async def _take_frame(self) -> Frame:
        """Wait for the next frame to plan."""
        await self._arrived.wait()
        self._arrived.clear()
        assert self._pending is not None  # noqa: S101 - set before the event
        frame, self._pending = self._pending, None
        return frame

    def _build_push(self, frame: Frame) -> Push:
        return Push(
            name=f"frame {frame.number}",
            options={"policy": self._policy},
            arrived_s=frame.arrived_s,
            epoch=frame.epoch,
            caller=self._caller,
            streamed=True,
            lists_pulses=False,
        )

    def _refuse(self, frame: Frame, problem: Problem) -> None:
        self._publish(FrameResult(frame=frame.number, status="refused", problem=problem))

    def _follow(self, frame: Frame, report_json: bytes) -> None:
        """Publish that a frame is planned, and its end when that comes."""
        report = PlanReport.model_validate_json(report_json)
        self._publish(report_planned(frame.number, report))
        watcher = asyncio.create_task(self._watch(frame.number, report.plan))
        self._last_watcher, self._last_epoch = watcher, frame.epoch
        self._watchers.add(watcher)
        watcher.add_done_callback(self._watchers.discard)

    async def _watch(self, number: int, plan: str) -> None:
        try:
            report = await self._daemon.planner.wait_for_end(plan)
        except OptodriveError as error:
            self._publish(FrameResult(frame=number, status=PlanStatus.FAILED, plan=plan, error=str(error)))
            return
        self._publish(_report_ended(number, report))

    def _publish(self, result: FrameResult) -> None:
        try:
            self._outbox.put_nowait(result)
        except asyncio.QueueFull:
            self._arrived.clear()
            raise WebSocketDisconnect(CLOSE_SLOW_READER) from None

    async def _write(self) -> None:
        while True:
            await self._socket.send_text((await self._outbox.get()).to_json())


def report_planned(number: int, report: PlanReport) -> FrameResult:
    """Return the result of a frame that is planned."""
    redrawn = report.summary.redrawn
    intervals_s = {} if redrawn is None else {"interval_min_s": redrawn.min_s, "interval_max_s": redrawn.max_s}
    result = FrameResult(
        frame=number,
        status=PlanStatus.PLANNED,
        plan=report.plan,
        pulses=report.planned,
        skipped=len(report.summary.skipped),
        trimmed=report.summary.trimmed.pulses,
        limited_by=report.summary.limited_by,
        starts_in_s=report.starts_in_s,
        duration_s=report.summary.duration_s,
        latency=report.latency,
    )
    return result.model_copy(update=intervals_s)


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


REFRESH_MIN_S, REFRESH_MAX_S = 0.008, 0.04
CAPS_PERIOD_S = 1.0
"""Time over which the caps are collected that took light from the frame. Its client is told when they are others."""
TRIED_AGAIN = (BusyError.code,)
"""Codes of the problems after which a frame still stands."""


class StandingStream(LiveStream):
    """Stream of one client whose newest frame stands.

    touched_only: leave dots dark that no finger touches
    """

    def __init__(
        self, daemon: DaemonClient, socket: WebSocket, policy: Policy, caller: str, touched_only: bool
    ) -> None:
        super().__init__(daemon, socket, policy, caller)
        self._touched_only = touched_only
        self._shown: Frame | None = None
        self._began_s = -inf
        self._fingers_arrived_s: float | None = None
        self._caps: set[str] = set()
        self._published_caps: set[str] = set()
        self._caps_since_s = -inf
        self._fingers_moved = asyncio.Event()

    async def run(self) -> None:
        """Serve until the client disconnects. Then the frame ends."""
        self._daemon.fingers_callbacks.add(self._on_fingers)
        try:
            await super().run()
        finally:
            self._daemon.fingers_callbacks.discard(self._on_fingers)

    def _on_fingers(self, arrived_s: float) -> None:
        if self._fingers_arrived_s is None:
            self._fingers_arrived_s = arrived_s
        self._fingers_moved.set()

    def _may_emit(self) -> bool:
        return self._shown is not None

    async def _take_frame(self) -> Frame:
        """Wait for a frame, or for the time to refresh the one that stands."""
        if self._shown is not None:
            await _wait_for_any(self._began_s + REFRESH_MIN_S, self._arrived)
            await _wait_for_any(self._began_s + REFRESH_MAX_S, self._arrived, self._fingers_moved)
            if not self._arrived.is_set():
                return self._shown
        return await super()._take_frame()

    def _build_push(self, frame: Frame) -> Push:
        """Build the push of a refresh, whose latency counts from the arrival of the first fingers that it follows."""
        self._began_s = time.monotonic()
        push = super()._build_push(frame)._replace(standing=True, touched_only=self._touched_only)
        arrived_s, self._fingers_arrived_s = self._fingers_arrived_s, None
        self._fingers_moved.clear()
        if frame is not self._shown:
            return push
        return push._replace(refreshes=True, arrived_s=self._began_s if arrived_s is None else arrived_s)

    def _follow(self, frame: Frame, report_json: bytes) -> None:
        if frame is self._shown:
            self._publish_caps(frame, RefreshReport.model_validate_json(report_json).limited_by)
            return
        if self._shown is not None:
            superseded = FrameResult(frame=self._shown.number, status=PlanStatus.SUPERSEDED, superseded_by=frame.number)
            self._publish(superseded)
        self._shown, self._last_epoch = frame, frame.epoch
        planned = report_planned(frame.number, PlanReport.model_validate_json(report_json))
        self._published_caps, self._caps, self._caps_since_s = set(planned.limited_by or ()), set(), time.monotonic()
        self._publish(planned)

    def _publish_caps(self, frame: Frame, limited_by: list[str]) -> None:
        """Collect the caps that took light from refreshes, and publish them when they are others than before."""
        self._caps.update(limited_by)
        if time.monotonic() < self._caps_since_s + CAPS_PERIOD_S:
            return
        if self._caps != self._published_caps:
            self._publish(FrameResult(frame=frame.number, status=PlanStatus.PLANNED, limited_by=sorted(self._caps)))
        self._published_caps, self._caps, self._caps_since_s = self._caps, set(), time.monotonic()

    def _refuse(self, frame: Frame, problem: Problem) -> None:
        if frame is self._shown:
            # A page stands through a busy moment; the next refresh tries again.
            if problem.code in TRIED_AGAIN:
                return
            self._shown = None
        super()._refuse(frame, problem)


async def _wait_for_any(until_s: float, *events: asyncio.Event) -> None:
    """Wait until one of some events is set, but no longer than until a monotonic time."""
    timeout_s = until_s - time.monotonic()
    if timeout_s <= 0.0 or any(event.is_set() for event in events):
        return
    waits = [asyncio.ensure_future(event.wait()) for event in events]
    try:
        await asyncio.wait(waits, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
