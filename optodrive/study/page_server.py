"""The web server of a study's pages, in a thread of the process that runs the study.

Theory of operation. Each page has a secret of its own behind `#token=` in its address, which a browser sends nowhere by
itself; the page opens a WebSocket with it, as the daemon's own clients do. The files of the pages hold no secret. Host
and Origin of every request are checked as by the daemon. No route reads a body, and messages are bounded. A page gets
views only: it is sent the newest one after each change, and no more than one waits for a slow page.
"""

import asyncio
import secrets
import socket
import threading
import time
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, NamedTuple, Self

import uvicorn
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket

from optodrive.core.errors import InputError, OptodriveError
from optodrive.daemon.api.host_check import LOOPBACK_NAMES, read_subprotocol_token, select_subprotocol
from optodrive.daemon.server.bounded_protocols import Utf8WebSocket
from optodrive.study.page_messages import (
    MESSAGE_MAX_BYTES,
    OPERATOR_MESSAGES,
    PARTICIPANT_MESSAGES,
    AnswerMessage,
    HostCheck,
    PageAddress,
    SeenMessage,
    build_response,
    read_files,
)
from optodrive.study.page_respondent import PageRespondent

CONNECTIONS_MAX = 64
PING_INTERVAL_S, PING_TIMEOUT_S = 5.0, 20.0
"""A page that does not answer a ping for this long is lost. One that comes back before that replaces itself."""
CLOSE_WAIT_S = 2.0
"""Limit for the last view to reach the pages."""
NORMAL, INVALID, UNAUTHORISED, REPLACED = 1000, 1008, 4401, 4409
"""Codes with which a page's WebSocket is closed; the pages tell them apart."""


class Closure(NamedTuple):
    """Why the server closes a page's WebSocket."""

    code: int
    reason: str


class StudyPages:
    """The pages of one run of a session, as a context manager: they show its end, too.

    stop: stops the display; it is called in a thread of its own
    """

    def __init__(self, respondent: PageRespondent, address: PageAddress, stop: Callable[[], None]) -> None:
        """Listen. Raise InputError if the address cannot be used."""
        try:
            self._listener = socket.create_server((address.host, address.port))
        except OSError as error:
            reason = str(error.strerror).partition(" (while")[0]  # the socket module repeats the address there
            raise InputError("--page", f"{address.host}:{address.port}", f"a free address ({reason})") from None
        self._respondent, self._stop = respondent, stop
        self._participant_token, self._operator_token = secrets.token_urlsafe(16), secrets.token_urlsafe(16)
        base = f"http://{address.host}:{self._listener.getsockname()[1]}"
        self.participant_url = f"{base}/participant#token={self._participant_token}"
        self.operator_url = f"{base}/operator#token={self._operator_token}"
        self._loop: asyncio.AbstractEventLoop | None = None
        self._wakes: set[asyncio.Event] = set()
        self._is_empty = threading.Condition()
        hosts = {address.host.lower(), *(LOOPBACK_NAMES if address.is_local else ())}
        self._server = uvicorn.Server(
            uvicorn.Config(
                HostCheck(self._build_app(), hosts),
                ws=Utf8WebSocket,
                ws_max_size=MESSAGE_MAX_BYTES,
                ws_per_message_deflate=False,  # a small frame could need any amount of memory
                ws_ping_interval=PING_INTERVAL_S,
                ws_ping_timeout=PING_TIMEOUT_S,
                lifespan="off",
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                limit_concurrency=CONNECTIONS_MAX,
                timeout_graceful_shutdown=1,
            )
        )
        self._thread = threading.Thread(target=self._server.run, args=([self._listener],), daemon=True)

    def __enter__(self) -> Self:
        self._respondent.on_change = self._wake_all
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._respondent.finish(error)
        with self._is_empty:
            self._is_empty.wait_for(lambda: not self._wakes, CLOSE_WAIT_S)
        self._respondent.on_change = lambda: None
        self._server.should_exit = True
        self._thread.join()

    def _build_app(self) -> Starlette:
        contents = read_files()

        async def get_page(request: Request) -> Response:
            return build_response(f"{request.url.path.removeprefix('/')}.html", contents)

        async def get_file(request: Request) -> Response:
            return build_response(request.path_params["name"], contents)

        return Starlette(
            routes=[
                Route("/participant", get_page),
                Route("/operator", get_page),
                Route("/page/{name}", get_file),
                WebSocketRoute("/participant/socket", self._serve_participant),
                WebSocketRoute("/operator/socket", self._serve_operator),
            ]
        )

    async def _serve_participant(self, page: WebSocket) -> None:
        if not await _accept(page, self._participant_token):
            return
        connection = self._respondent.join()
        views = _SentViews()
        try:
            with _Wake(self) as wake:
                await _run(
                    page,
                    self._send_participant_views(page, connection, views, wake),
                    self._receive_participant(page, connection, views),
                )
        finally:
            self._respondent.leave(connection)

    async def _serve_operator(self, page: WebSocket) -> None:
        if await _accept(page, self._operator_token):
            with _Wake(self) as wake:
                await _run(page, self._send_operator_views(page, wake), self._receive_operator(page))

    async def _send_participant_views(
        self, page: WebSocket, connection: int, views: "_SentViews", wake: asyncio.Event
    ) -> Closure:
        while True:
            wake.clear()
            view = self._respondent.build_participant_view(connection)
            if view is None:
                return Closure(REPLACED, "opened in another window")
            await page.send_json({"view": views.count(time.monotonic()), **view.model_dump(mode="json")})
            if view.phase in ("done", "stopped"):
                return Closure(NORMAL, "")
            await wake.wait()

    async def _receive_participant(self, page: WebSocket, connection: int, views: "_SentViews") -> Closure | None:
        async for text, arrived_s in _iterate_messages(page):
            try:
                message = PARTICIPANT_MESSAGES.validate_json(text)
            except ValidationError as error:
                return Closure(INVALID, _describe(error))
            if isinstance(message, SeenMessage):
                views.take_seen(message.view, arrived_s)
                continue
            latency_s = None
            if isinstance(message, AnswerMessage) and views.round_trip_s is not None:
                latency_s = message.handled_s + views.round_trip_s
            self._respondent.receive(connection, message, arrived_s, latency_s)
        return None

    async def _send_operator_views(self, page: WebSocket, wake: asyncio.Event) -> Closure:
        while True:
            wake.clear()
            view = self._respondent.build_operator_view()
            await page.send_json({**view.model_dump(mode="json"), "participant_token": self._participant_token})
            if view.phase in ("done", "stopped"):
                return Closure(NORMAL, "")
            await wake.wait()

    async def _receive_operator(self, page: WebSocket) -> Closure | None:
        async for text, _ in _iterate_messages(page):
            try:
                command = OPERATOR_MESSAGES.validate_json(text).kind
            except ValidationError as error:
                return Closure(INVALID, _describe(error))
            if command == "stop":
                await run_in_threadpool(self._stop_display)
            else:
                self._respondent.set_paused(command == "pause")
        return None

    def _stop_display(self) -> None:
        try:
            self._stop()
            self._respondent.halt("the operator stopped the display; the session goes on with the same command")
        except OptodriveError as error:
            self._respondent.halt(f"STOP was not confirmed: {error}")

    def _wake_all(self) -> None:
        loop = self._loop
        if loop is not None:
            loop.call_soon_threadsafe(self._set_wakes)

    def _set_wakes(self) -> None:
        for wake in self._wakes:
            wake.set()

    def add_wake(self, wake: asyncio.Event) -> None:
        """Set an event after each change, until it is removed."""
        self._loop = asyncio.get_running_loop()
        self._wakes.add(wake)

    def remove_wake(self, wake: asyncio.Event) -> None:
        """Set an event no longer."""
        with self._is_empty:
            self._wakes.discard(wake)
            self._is_empty.notify_all()


class _Wake(asyncio.Event):
    """An event that each change sets, while it is entered."""

    def __init__(self, pages: StudyPages) -> None:
        super().__init__()
        self._pages = pages

    def __enter__(self) -> Self:
        self._pages.add_wake(self)
        return self

    def __exit__(self, *error: object) -> None:
        self._pages.remove_wake(self)


class _SentViews:
    """The newest view that was sent to a page, and the round trip to it.

    round_trip_s: from the sending of a view to the arrival of the page's reply, None before the first one
    """

    def __init__(self) -> None:
        self.round_trip_s: float | None = None
        self._number, self._sent_s = 0, 0.0

    def count(self, now_s: float) -> int:
        """Return the number of a view that is sent now."""
        self._number, self._sent_s = self._number + 1, now_s
        return self._number

    def take_seen(self, number: int, arrived_s: float) -> None:
        """Take a page's reply to a view."""
        if number == self._number:
            self.round_trip_s = arrived_s - self._sent_s


async def _accept(page: WebSocket, token: str) -> bool:
    """Accept a WebSocket. Close it at once if it presents another token: a refused one could not tell its page why."""
    presented = read_subprotocol_token(dict(page.headers))
    await page.accept(select_subprotocol(page.scope))
    if secrets.compare_digest(presented.encode(), token.encode()):
        return True
    await page.close(UNAUTHORISED, "not the token of this page")
    return False


async def _run(page: WebSocket, *work: Coroutine[Any, Any, Closure | None]) -> None:
    """Send and receive until one of them ends, and close the page as that one says.

    Neither closes by itself, so that nothing is sent after a close. Raise WebSocketDisconnect if the page has left.
    """
    tasks = [asyncio.ensure_future(each) for each in work]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            raise result
        if isinstance(result, Closure):
            await page.close(*result)
            return


async def _iterate_messages(page: WebSocket) -> Any:
    """Yield each message with the time of its arrival, until the page has gone."""
    while (message := await page.receive())["type"] != "websocket.disconnect":
        yield message.get("text") or message.get("bytes") or b"", time.monotonic()


def _describe(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    return f"{'.'.join(map(str, first['loc'])) or 'message'}: {first['msg']}"[:120]
