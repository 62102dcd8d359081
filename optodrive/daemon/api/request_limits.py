"""Limits of a request's input: the size of its body, the rate of a stream's frames."""

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
    """A body exceeds its maximum size."""


class BoundedBody:
    """Bounds a body, also one without a content length, and computes its digest for the audit log."""

    def __init__(self, receive: Receive, max_bytes: int) -> None:
        self._receive = receive
        self._max_bytes = max_bytes
        self._digest = sha256()
        self.size_bytes = 0

    async def __call__(self) -> Message:
        """Return the next chunk. Raise BodyTooLargeError if the body exceeds its maximum size."""
        message = await self._receive()
        if message["type"] == "http.request":
            chunk = message.get("body", b"")
            self.size_bytes += len(chunk)
            if self.size_bytes > self._max_bytes:
                await self._discard_rest(message)
                raise BodyTooLargeError
            self._digest.update(chunk)
        return message

    async def _discard_rest(self, message: Message) -> None:
        """Read and discard the rest of a body, up to its maximum size again.

        A connection that is closed before its input was read is reset, which may take the answer from the client.
        """
        while message.get("more_body") and self.size_bytes <= 2 * self._max_bytes:
            message = await self._receive()
            self.size_bytes += len(message.get("body", b""))

    @property
    def audit_fields(self) -> dict[str, object]:
        """Size and SHA-256 of the body, empty if there is none."""
        return {"body_bytes": self.size_bytes, "body_sha256": self._digest.hexdigest()} if self.size_bytes else {}


class RateLimitedFrames:
    """Receives a stream's frames no faster than the caller's rate. Frames beyond it wait in the caller's socket.

    acquire: counts a frame and returns the time to wait first, s
    """

    def __init__(self, receive: Receive, acquire: Callable[[], float]) -> None:
        self._receive = receive
        self._acquire = acquire
        self.frame_count = 0

    async def __call__(self) -> Message:
        """Return the next message, a frame once its rate allows it."""
        message = await self._receive()
        if message["type"] == "websocket.receive":
            self.frame_count += 1
            while (wait_s := self._acquire()) > 0.0:
                await asyncio.sleep(wait_s)
        return message

    @property
    def audit_fields(self) -> dict[str, object]:
        """The number of frames."""
        return {"frames": self.frame_count}


async def receive_empty_body() -> Message:
    """Return an empty body in place of one that is not read."""
    return {"type": "http.request", "body": b"", "more_body": False}
