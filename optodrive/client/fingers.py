"""Places of fingertips, reported to a daemon."""

from collections.abc import Sequence
from contextlib import AsyncExitStack
from typing import Self

from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed

from optodrive.client.endpoint import Endpoint
from optodrive.client.loop_thread import LoopThread
from optodrive.client.socket_connection import open_connection
from optodrive.core.errors import LinkError
from optodrive.core.types.fingers import FingerPlace
from optodrive.daemon.responses.fingers import validate_fingers

PATH = "/v1/fingers"


class Fingers:
    """A tracker's connection. `Display.fingers()` builds one: `with display.fingers() as fingers: fingers.send(…)`."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._exit_stack = AsyncExitStack()
        self._loop = LoopThread("fingers")
        try:
            self._connection: ClientConnection = self._loop.run(open_connection(endpoint, PATH, self._exit_stack))
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

        Raise LinkError without a connection, and InputError for a place that the display cannot have.
        """
        message = validate_fingers({"fingers": [place._asdict() for place in places], "age_s": age_s})
        self._loop.run(self._send(message.model_dump_json()))

    async def _send(self, text: str) -> None:
        try:
            await self._connection.send(text)
        except ConnectionClosed:
            raise LinkError("the daemon has closed the connection of the fingers") from None
