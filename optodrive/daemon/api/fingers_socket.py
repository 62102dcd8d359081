"""Places of fingertips over a WebSocket: the newest ones go to the planner process and wake the standing pages."""

import asyncio
import time

from starlette.websockets import WebSocket

from optodrive.core.errors import BusyError, OptodriveError
from optodrive.daemon.api.daemon_client import DaemonClient
from optodrive.daemon.api.scope_keys import ARRIVED_S, EARLIEST_S
from optodrive.daemon.api.socket_token import select_subprotocol
from optodrive.daemon.responses.messages import FingersMessage, FingersRefusal, validate_fingers
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
            await asyncio.sleep(FORWARD_PERIOD_S)


def parse_fingers(message: str | bytes) -> FingersMessage:
    """Parse a message. Raise InputError, also for invalid JSON and for a repeated key."""
    return validate_fingers(decode_json(message, "message"))
