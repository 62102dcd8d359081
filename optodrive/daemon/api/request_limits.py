"""A request as every check reads it: path, headers, keys of its scope, and the limits of its body and its frames."""

import asyncio
import re
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from contextlib import suppress
from hashlib import sha256
from typing import Any
from urllib.parse import quote

CALLER = "optodrive.caller"
"""Key in the ASGI scope of the token that the request presented, ANONYMOUS without one."""
ARRIVED_S = "arrived_s"
"""Key in the state of an ASGI scope, and in a WebSocket's message, of the monotonic time at which it arrived."""
EARLIEST_S = "earliest_s"
"""Key in a WebSocket's message of the earliest monotonic time at which it may have arrived."""


STOP_PATH = "/v1/stop"
AUTHORITY = re.compile(r"https?://[^/]*", re.IGNORECASE)


def normalise_path(path: str) -> str:
    """Return the path of a decoded request target: without scheme and host, and STOP's without a slash at its end."""
    authority = AUTHORITY.match(path)
    if authority is not None:
        path = path[authority.end() :] or "/"
    return STOP_PATH if path == STOP_PATH + "/" else path


def join_headers(lines: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the headers by lower-case name, the values of a repeated one as a list, which no Host or Origin is."""
    headers: dict[str, str] = {}
    for name, value in lines:
        key = name.lower()
        headers[key] = f"{headers[key]}, {value}" if key in headers else value
    return headers


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
                # The answer must reach the client, which still writes.
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


HOLD_MAX_S = 0.1
"""The longest time that one STOP delays other requests; STOP itself takes seconds if the board does not answer."""


class StopPriorityMiddleware:
    """ASGI middleware that starts one request per iteration of the loop, and none while STOP is being answered.

    permits_stop: whether a request for STOP has what STOP needs; another one waits for its turn like any request

    Without it, the loop starts all requests that have arrived before it polls its sockets again, and STOP's response
    waits behind all of them.
    """

    def __init__(self, app: App, permits_stop: Callable[[Scope], bool]) -> None:
        self._app = app
        self._permits_stop = permits_stop
        self._start_lock = asyncio.Lock()
        self._stops_in_progress = 0
        self._hold_deadline_s = 0.0
        self._stop_done = asyncio.Event()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward the request when its turn comes, and STOP at once. Routes get the path in its usual form."""
        if "path" in scope:
            path = normalise_path(scope["path"])
            if path != scope["path"]:
                scope["path"], scope["raw_path"] = path, quote(path).encode()
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif scope["path"] == STOP_PATH and self._permits_stop(scope):
            await self._serve_stop(scope, receive, send)
        else:
            async with self._start_lock:
                # One iteration of the loop, in which it polls its sockets and starts a STOP that has arrived.
                await asyncio.sleep(0)
                if self._stops_in_progress:
                    with suppress(TimeoutError):
                        # Bounded: a board that does not answer STOP must not stop the API.
                        async with asyncio.timeout_at(self._hold_deadline_s):
                            await self._stop_done.wait()
            await self._app(scope, receive, send)

    async def _serve_stop(self, scope: Scope, receive: Receive, send: Send) -> None:
        if not self._stops_in_progress:
            self._stop_done.clear()
            # Of the first STOP: a client that repeats it could hold all others else.
            self._hold_deadline_s = asyncio.get_running_loop().time() + HOLD_MAX_S
        self._stops_in_progress += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._stops_in_progress -= 1
            if not self._stops_in_progress:
                self._stop_done.set()
