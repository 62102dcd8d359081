"""Places of fingertips, reported to a daemon."""

import asyncio
from collections.abc import Sequence
from contextlib import AsyncExitStack, suppress
from typing import Self

from websockets.exceptions import ConnectionClosed

from optodrive.client.endpoint import Endpoint
from optodrive.client.loop_thread import LoopThread
from optodrive.client.problems import build_error
from optodrive.client.socket_connection import open_connection
from optodrive.core.errors import LinkError, OptodriveError
from optodrive.core.types.fingers import FingerPlace
from optodrive.core.types.push_options import check_keywords
from optodrive.daemon.responses.fingers import FingersRefusal, validate_fingers

PATH = "/v1/fingers"


@check_keywords
class Fingers:
    """A tracker's connection. `Display.fingers()` builds one: `with display.fingers() as fingers: fingers.send(…)`."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._exit_stack = AsyncExitStack()
        self._loop = LoopThread("fingers")
        self._refusal: OptodriveError | None = None
        try:
            self._loop.run(self._open(endpoint))
        except BaseException:
            self._loop.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection: the daemon then knows of no finger."""
        self._loop.run(self._exit_stack.aclose())
        self._loop.close()

    def send(self, places: Sequence[FingerPlace], age_s: float = 0.0) -> None:
        """Report all fingertips, none if there is none. age_s: time since they were there.

        Raise LinkError without a connection, and InputError for a place that the display cannot have. Raise BusyError,
        once, if places before these waited too long to count: the next ones may be sent, less often.
        """
        refusal, self._refusal = self._refusal, None
        if refusal is not None:
            raise refusal
        message = validate_fingers({"fingers": [place._asdict() for place in places], "age_s": age_s})
        self._loop.run(self._send(message.model_dump_json()))

    async def _open(self, endpoint: Endpoint) -> None:
        self._connection = await open_connection(endpoint, PATH, self._exit_stack)
        self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        """Take refusals. Those that nobody reads would end in a connection that reads no sign of life, and is lost."""
        with suppress(ConnectionClosed):
            async for text in self._connection:
                self._refusal = build_error(FingersRefusal.model_validate_json(text).problem)

    async def _send(self, text: str) -> None:
        try:
            await self._connection.send(text)
        except ConnectionClosed:
            raise LinkError("the daemon has closed the connection of the fingers") from None
