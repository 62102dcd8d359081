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


HELD_S = 0.1
"""A STOP holds others up for so long at most: one may take seconds where the board does not answer."""


class InTurn:
    """ASGI middleware: one request begins in a turn of the web server's loop, and none while STOP is answered.

    Without it every request that has arrived begins before the loop looks at its sockets again, and STOP's answer
    waits behind all of them.
    """

    def __init__(self, app: App) -> None:
        self._app = app
        self._turn = asyncio.Lock()
        self._stops = 0
        self._held_until_s = 0.0
        self._answered = asyncio.Event()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on when it is its turn."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif scope["path"] == STOP_PATH:
            await self._stop(scope, receive, send)
        else:
            async with self._turn:
                await asyncio.sleep(0)
                if self._stops:
                    with suppress(TimeoutError):
                        async with asyncio.timeout_at(self._held_until_s):
                            await self._answered.wait()
            await self._app(scope, receive, send)

    async def _stop(self, scope: Scope, receive: Receive, send: Send) -> None:
        if not self._stops:
            self._answered.clear()
            self._held_until_s = asyncio.get_running_loop().time() + HELD_S
        self._stops += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._stops -= 1
            if not self._stops:
                self._answered.set()


async def written(answer: dict[str, Any], status: int = 200) -> Response:
    """A JSON answer, which may list thousands of pulses, written beside the web server's loop.

    The encoder holds the interpreter as long as it is at one piece; a column of a plan's pulses takes milliseconds.
    """
    body = await run_in_threadpool(lambda: "".join(pieces(answer)).encode())
    return Response(body, status, media_type="application/json")


def pieces(value: object) -> Iterator[str]:
    """JSON, one piece for whatever is no object."""
    if not isinstance(value, dict) or not value:
        yield json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
        return
    before = "{"
    for key, item in value.items():
        yield f"{before}{json.dumps(str(key), ensure_ascii=False)}:"
        yield from pieces(item)
        before = ","
    yield "}"
