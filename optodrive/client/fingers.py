"""Places of fingertips, reported to a daemon."""

import asyncio
from collections.abc import Sequence
from contextlib import AsyncExitStack, suppress
from typing import Self

from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed

from optodrive.client.endpoint import Endpoint
from optodrive.client.loop_thread import LoopThread
from optodrive.client.problems import build_error
from optodrive.client.socket_connection import open_connection
from optodrive.core.errors import LinkError, NotReadyError, OptodriveError
from optodrive.core.types.fingers import FingerPlace
from optodrive.core.types.push_options import check_keywords
from optodrive.daemon.responses.messages import FingersRefusal, validate_fingers

PATH = "/v1/fingers"


@check_keywords
class AsyncFingers:
    """A tracker's connection that opens when entered. See `Fingers`."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._exit_stack = AsyncExitStack()
        self._connection: ClientConnection | None = None
        self._reading: asyncio.Task[None] | None = None
        self._refusal: OptodriveError | None = None

    async def __aenter__(self) -> Self:
        self._connection = await open_connection(self._endpoint, PATH, self._exit_stack)
        self._reading = asyncio.create_task(self._read(self._connection))
        return self

    async def __aexit__(self, *details: object) -> None:
        await self.close()

    async def close(self) -> None:
        """See `Fingers.close`."""
        await self._exit_stack.aclose()

    async def send(self, places: Sequence[FingerPlace], age_s: float = 0.0) -> None:
        """See `Fingers.send`."""
        refusal, self._refusal = self._refusal, None
        if refusal is not None:
            raise refusal
        message = validate_fingers({"fingers": [place._asdict() for place in places], "age_s": age_s})
        if self._connection is None:
            raise NotReadyError("the connection of the fingers is not open: `async with display.fingers() as fingers`")
        try:
            await self._connection.send(message.model_dump_json())
        except ConnectionClosed:
            raise LinkError("the daemon has closed the connection of the fingers") from None

    async def _read(self, connection: ClientConnection) -> None:
        """Take refusals. Those that nobody reads would end in a connection that reads no sign of life, and is lost."""
        with suppress(ConnectionClosed):
            async for text in connection:
                self._refusal = build_error(FingersRefusal.model_validate_json(text).problem)


@check_keywords
class Fingers:
    """A tracker's connection. `Display.fingers()` builds one: `with display.fingers() as fingers: fingers.send(…)`."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._fingers = AsyncFingers(endpoint)
        self._loop = LoopThread("fingers")
        try:
            self._loop.run(self._fingers.__aenter__())
        except BaseException:
            self._loop.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection: the daemon then knows of no finger."""
        self._loop.run(self._fingers.close())
        self._loop.close()

    def send(self, places: Sequence[FingerPlace], age_s: float = 0.0) -> None:
        """Report all fingertips, none if there is none. age_s: time since they were there.

        Raise LinkError without a connection, and InputError for a place that the display cannot have. Raise BusyError,
        once, if places before these waited too long to count: the next ones may be sent, less often.
        """
        self._loop.run(self._fingers.send(places, age_s))
