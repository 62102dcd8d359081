"""What keeps STOP prompt while many call.

Requests begin in turn, and none while STOP is answered; long answers are written piece by piece.
"""

import asyncio
import json
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from fastapi.responses import Response
from starlette.concurrency import run_in_threadpool

from optodrive.daemon.web.request_limits import App, Receive, Scope, Send

STOP_PATH = "/v1/stop"


HOLD_MAX_S = 0.1
"""A STOP holds others up for so long at most: one may take seconds where the board does not answer."""


class StopPriorityMiddleware:
    """ASGI middleware: one request begins in a turn of the web server's loop, and none while STOP is answered.

    Without it every request that has arrived begins before the loop looks at its sockets again, and STOP's answer
    waits behind all of them.
    """

    def __init__(self, app: App) -> None:
        self._app = app
        self._start_lock = asyncio.Lock()
        self._stops_in_progress = 0
        self._hold_deadline_s = 0.0
        self._stop_done = asyncio.Event()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on when it is its turn."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif scope["path"] == STOP_PATH:
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


async def build_json_response(content: dict[str, Any], status: int = 200) -> Response:
    """A JSON answer, which may list thousands of pulses, written beside the web server's loop.

    The encoder holds the interpreter as long as it is at one piece; a column of a plan's pulses takes milliseconds.
    """
    body = await run_in_threadpool(lambda: "".join(iterate_json(content)).encode())
    return Response(body, status, media_type="application/json")


def iterate_json(value: object) -> Iterator[str]:
    """JSON, one piece for whatever is no object."""
    if not isinstance(value, dict) or not value:
        yield json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
        return
    separator = "{"
    for key, item in value.items():
        yield f"{separator}{json.dumps(str(key), ensure_ascii=False)}:"
        yield from iterate_json(item)
        separator = ","
    yield "}"
