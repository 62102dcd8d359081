"""Arming that lasts as long as a WebSocket and the beats of its client."""

import asyncio
import secrets
import time

from starlette.websockets import WebSocket

from optodrive.core.errors import InputError, OptodriveError
from optodrive.daemon.api.daemon_client import LinkClient
from optodrive.daemon.api.scope_keys import ARRIVED_S
from optodrive.daemon.api.socket_token import select_subprotocol
from optodrive.daemon.responses.messages import HoldReport
from optodrive.daemon.responses.problem import build_error_problem

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
