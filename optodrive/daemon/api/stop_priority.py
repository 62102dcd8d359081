"""Measures that keep STOP's response time short under load.

Requests start one at a time, and none starts while STOP is being answered.
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from urllib.parse import quote

from optodrive.daemon.api.request_limits import STOP_PATH, App, Receive, Scope, Send, normalise_path

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
                await asyncio.sleep(0)
                if self._stops_in_progress:
                    with suppress(TimeoutError):
                        async with asyncio.timeout_at(self._hold_deadline_s):
                            await self._stop_done.wait()
            await self._app(scope, receive, send)

    async def _serve_stop(self, scope: Scope, receive: Receive, send: Send) -> None:
        if not self._stops_in_progress:
            self._stop_done.clear()
            self._hold_deadline_s = asyncio.get_running_loop().time() + HOLD_MAX_S
        self._stops_in_progress += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._stops_in_progress -= 1
            if not self._stops_in_progress:
                self._stop_done.set()
