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

    def __init__(self, receive: Receive, max_bytes: int) -> None:
        self._receive = receive
        self._max_bytes = max_bytes
        self._digest = sha256()
        self.size_bytes = 0

    async def __call__(self) -> Message:
        """The next piece."""
        message = await self._receive()
        if message["type"] == "http.request":
            chunk = message.get("body", b"")
            self.size_bytes += len(chunk)
            if self.size_bytes > self._max_bytes:
                raise BodyTooLargeError
            self._digest.update(chunk)
        return message

    @property
    def audit_fields(self) -> dict[str, object]:
        """Size and SHA-256 of what was read; nothing where nothing was."""
        return {"body_bytes": self.size_bytes, "body_sha256": self._digest.hexdigest()} if self.size_bytes else {}


class RateLimitedFrames:
    """Takes a stream's frames no faster than a caller may ask; what comes faster waits in the caller's own socket.

    wait_s: counts a frame, says how long to wait first, s
    """

    def __init__(self, receive: Receive, acquire: Callable[[], float]) -> None:
        self._receive = receive
        self._acquire = acquire
        self.frame_count = 0

    async def __call__(self) -> Message:
        """The next frame, in its time."""
        message = await self._receive()
        if message["type"] == "websocket.receive":
            self.frame_count += 1
            while (wait_s := self._acquire()) > 0.0:
                await asyncio.sleep(wait_s)
        return message

    @property
    def audit_fields(self) -> dict[str, object]:
        """How many frames came."""
        return {"frames": self.frame_count}


async def receive_empty_body() -> Message:
    """In place of a body that is not to be read."""
    return {"type": "http.request", "body": b"", "more_body": False}
