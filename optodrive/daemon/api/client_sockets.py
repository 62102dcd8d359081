"""WebSockets of clients that go on: places of fingertips, and an arming that lasts as long as its connection.

The newest places go to the planner process and wake the standing pages.
"""

import asyncio
import secrets
import time

from starlette.websockets import WebSocket

from optodrive.core.errors import BusyError, InputError, OptodriveError
from optodrive.daemon.api.daemon_client import DaemonClient, LinkClient
from optodrive.daemon.api.host_check import select_subprotocol
from optodrive.daemon.api.request_limits import ARRIVED_S, EARLIEST_S
from optodrive.daemon.responses.messages import FingersMessage, FingersRefusal, HoldReport, validate_fingers
from optodrive.daemon.responses.problem import build_error_problem
from optodrive.planning.stimuli.json_values import decode_json

FORWARD_PERIOD_S = 0.005
"""Least time between two messages to the planner; of those in between the newest counts."""
WAITED_MAX_S = 0.2
"""Longest time for which places may have waited in the socket: fingers have left those of a backlog."""


class FingersSocket:
    """One tracker."""

    def __init__(self, daemon: DaemonClient, socket: WebSocket) -> None:
        self._daemon, self._socket = daemon, socket
        self._newest: tuple[FingersMessage, float] | None = None
        self._arrived = asyncio.Event()
        self._is_late = False

    async def run(self) -> None:
        """Serve until the tracker disconnects."""
        await self._socket.accept(select_subprotocol(self._socket.scope))
        tasks = [asyncio.create_task(work) for work in (self._read(), self._forward())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _read(self) -> None:
        while (message := await self._socket.receive())["type"] != "websocket.disconnect":
            was_late, self._is_late = self._is_late, time.monotonic() - message[EARLIEST_S] > WAITED_MAX_S
            # One refusal for a backlog, not one for each of its messages.
            if was_late and self._is_late:
                continue
            try:
                if self._is_late:
                    raise BusyError("the places have waited behind others: report at most `requests_per_s` per second")
                fingers = parse_fingers(message.get("text") or message.get("bytes") or b"")
            except OptodriveError as error:
                await self._socket.send_text(FingersRefusal(problem=build_error_problem(error)).model_dump_json())
                continue
            self._newest = fingers, message[ARRIVED_S]
            self._arrived.set()

    async def _forward(self) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            assert self._newest is not None  # noqa: S101 - set before the event
            fingers, arrived_s = self._newest
            self._daemon.send_fingers(fingers.places, arrived_s - fingers.age_s, arrived_s)
            # After sending, so that the first place after a rest is not delayed.
            await asyncio.sleep(FORWARD_PERIOD_S)


def parse_fingers(message: str | bytes) -> FingersMessage:
    """Parse a message. Raise InputError, also for invalid JSON and for a repeated key."""
    return validate_fingers(decode_json(message, "message"))


NORMAL_CLOSURE, POLICY_VIOLATION = 1000, 1008
BEAT = "beat"
CLIENT_LEFT = "the client that held the board armed has left"


class HoldSocket:
    """One client that holds the arming. caller: name of its token.

    The link process counts the time between the beats, so that a web process that hangs holds nothing.
    """

    def __init__(self, link: LinkClient, socket: WebSocket, caller: str) -> None:
        self._link = link
        self._socket = socket
        self._caller = caller
        self._arming = secrets.randbits(48)

    async def run(self) -> None:
        """Arm, and hold until the client leaves or the arming ends."""
        await self._socket.accept(select_subprotocol(self._socket.scope))
        tasks = [asyncio.create_task(work) for work in (self._forward_beats(), self._keep())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            # First, because this coroutine may be cancelled at its next await.
            self._link.release(self._arming, CLIENT_LEFT)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _forward_beats(self) -> None:
        """Take the client's messages as beats, at the time of their arrival. One that says something else lets go."""
        while (message := await self._socket.receive())["type"] != "websocket.disconnect":
            said = message.get("text") or message.get("bytes") or ""
            if said != BEAT:
                reason = str(InputError("message", said, f"'{BEAT}'"))
                self._link.release(self._arming, reason)  # before the answer, which may wait for the client
                await self._send_last(HoldReport(status="ended", reason=reason), POLICY_VIOLATION)
                return
            age_s = time.monotonic() - (message.get(ARRIVED_S) or time.monotonic())
            # With its age: a beat that waited in a loaded web process must not extend the hold.
            self._link.hold(self._arming, max(0.0, age_s))

    async def _keep(self) -> None:
        """Arm, and report that and the end of it."""
        try:
            await self._link.arm(self._caller, self._arming)
        except OptodriveError as error:
            await self._send_last(HoldReport(status="refused", problem=build_error_problem(error)), POLICY_VIOLATION)
            return
        ended = self._link.watch_arming(self._arming)
        await self._socket.send_text(HoldReport(status="armed").to_json())
        await self._send_last(HoldReport(status="ended", reason=await ended), NORMAL_CLOSURE)

    async def _send_last(self, report: HoldReport, code: int) -> None:
        await self._socket.send_text(report.to_json())
        await self._socket.close(code)
