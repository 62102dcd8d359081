"""What comes in with a request, bounded: the body of a call, the pace of a stream's frames."""

import asyncio
from collections.abc import Awaitable, Callable, MutableMapping
from hashlib import sha256
from typing import Any

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]


class BodyTooLargeError(Exception):
    """A body grew past its bound while it was read."""


class BoundedBody:
    """Counts what arrives, for bodies that announce no length, and takes its digest for the audit file."""

    def __init__(self, receive: Receive, limit_bytes: int) -> None:
        self._receive = receive
        self._limit_bytes = limit_bytes
        self._digest = sha256()
        self.size_bytes = 0

    async def __call__(self) -> Message:
        """The next piece."""
        message = await self._receive()
        if message["type"] == "http.request":
            piece = message.get("body", b"")
            self.size_bytes += len(piece)
            if self.size_bytes > self._limit_bytes:
                raise BodyTooLargeError
            self._digest.update(piece)
        return message

    @property
    def facts(self) -> dict[str, object]:
        """Size and SHA-256 of what was read; nothing where nothing was."""
        return {"body_bytes": self.size_bytes, "body_sha256": self._digest.hexdigest()} if self.size_bytes else {}


class PacedFrames:
    """Takes a stream's frames no faster than a caller may ask; what comes faster waits in the caller's own socket.

    wait_s: counts a frame, says how long to wait first, s
    """

    def __init__(self, receive: Receive, wait_s: Callable[[], float]) -> None:
        self._receive = receive
        self._wait_s = wait_s
        self.frames = 0

    async def __call__(self) -> Message:
        """The next frame, in its time."""
        message = await self._receive()
        if message["type"] == "websocket.receive":
            self.frames += 1
            while (wait_s := self._wait_s()) > 0.0:
                await asyncio.sleep(wait_s)
        return message

    @property
    def facts(self) -> dict[str, object]:
        """How many frames came."""
        return {"frames": self.frames}


async def nothing() -> Message:
    """In place of a body that is not to be read."""
    return {"type": "http.request", "body": b"", "more_body": False}
