"""A display, driven from asyncio: as `Display`, with `await`."""

import asyncio
import time
from collections.abc import Mapping
from contextlib import AsyncExitStack
from types import TracebackType
from typing import Any, Self

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from optodrive.client.answers import FrameResult, Plan, State
from optodrive.client.display import POLL_PERIOD_S, RECONNECT_TIMEOUT_S
from optodrive.client.heights import HeightsLike, build_layout, convert_to_pixels, encode_frame
from optodrive.client.http import DEFAULT_URL, RETRY_S, AsyncDaemonClient, Endpoint, JsonObject
from optodrive.client.requests import (
    ApiRequest,
    Fit,
    Policy,
    build_frame_body,
    build_plan_path,
    build_play_request,
    build_push_request,
)
from optodrive.client.stream import (
    CONNECTION_ERRORS,
    OPEN_TIMEOUT_S,
    RESULT_TIMEOUT_S,
    ResultBuffer,
    build_stream_url,
    parse_refusal,
    raise_if_failed,
)
from optodrive.core.errors import LinkError, OptodriveError
from optodrive.device.config import PixelLayout


class AsyncDisplay:
    """A display behind a running daemon, for `async with`; what is said of `Display` holds here."""

    def __init__(
        self, url: str = DEFAULT_URL, token: str | None = None, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
    ) -> None:
        self._client = AsyncDaemonClient(url, token, reconnect_timeout_s)
        self._reconnect_timeout_s = reconnect_timeout_s
        self._layout: PixelLayout | None = None
        self._may_emit = False

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._may_emit:
                await asyncio.shield(self.stop())  # a task that is cancelled stops what it lit all the same
        except OptodriveError as stop_error:
            if error is None:
                raise
            error.add_note(f"optodrive: {stop_error}")
        finally:
            await self.close()

    async def close(self) -> None:
        """Close the connections, and stop nothing."""
        await self._client.close()

    async def arm(self) -> State:
        """As `Display.arm`."""
        self._may_emit = True
        return State.from_response(await self._client.call("POST", "/v1/arm"))

    async def disarm(self) -> State:
        """As `Display.disarm`."""
        return State.from_response(await self._client.call("POST", "/v1/disarm"))

    async def stop(self) -> State:
        """As `Display.stop`."""
        state = State.from_response(await self._client.stop())
        self._may_emit = False
        return state

    async def state(self) -> State:
        """As `Display.state`."""
        return State.from_response(await self._client.call("GET", "/v1/state"))

    async def config(self) -> JsonObject:
        """As `Display.config`."""
        return await self._client.call("GET", "/v1/config")

    async def layout(self) -> PixelLayout:
        """As `Display.layout`."""
        if self._layout is None:
            self._layout = build_layout(await self.config())
        return self._layout

    async def show(
        self,
        heights_um: HeightsLike,
        duration_s: float = 1.0,
        *,
        simultaneous: bool = False,
        policy: Policy = "trim",
        fit: Fit = "as_is",
        wait: bool = True,
    ) -> Plan:
        """As `Display.show`."""
        body = build_frame_body(convert_to_pixels(heights_um, await self.layout()), duration_s, simultaneous)
        return await self.push(body, policy=policy, fit=fit, wait=wait)

    async def push(
        self, sequence: Mapping[str, Any], *, policy: Policy = "trim", fit: Fit = "as_is", wait: bool = True
    ) -> Plan:
        """As `Display.push`."""
        return await self._submit_and_wait(build_push_request(sequence, policy, fit, dry_run=False), wait)

    async def play(
        self,
        name: str,
        *,
        policy: Policy = "trim",
        fit: Fit = "as_is",
        dry_run: bool = False,
        wait: bool = True,
        **parameters: Any,
    ) -> Plan:
        """As `Display.play`."""
        request = build_play_request(name, parameters, policy, fit, dry_run)
        return await self._submit(request) if dry_run else await self._submit_and_wait(request, wait)

    async def preview(
        self,
        heights_um: HeightsLike,
        duration_s: float = 1.0,
        *,
        simultaneous: bool = False,
        policy: Policy = "trim",
        fit: Fit = "as_is",
    ) -> Plan:
        """As `Display.preview`."""
        body = build_frame_body(convert_to_pixels(heights_um, await self.layout()), duration_s, simultaneous)
        return await self._submit(build_push_request(body, policy, fit, dry_run=True))

    async def patterns(self) -> list[dict[str, Any]]:
        """As `Display.patterns`."""
        patterns: list[dict[str, Any]] = (await self._client.call("GET", "/v1/patterns"))["patterns"]
        return patterns

    async def plan(self, plan: Plan | str) -> Plan:
        """As `Display.plan`."""
        return Plan.from_response(
            await self._client.call("GET", build_plan_path(_get_plan_id(plan))), await self.layout()
        )

    async def cancel(self, plan: Plan | str) -> Plan:
        """As `Display.cancel`."""
        return Plan.from_response(
            await self._client.call("DELETE", build_plan_path(_get_plan_id(plan))), await self.layout()
        )

    async def wait(self, plan: Plan | str) -> Plan:
        """As `Display.wait`."""
        path = build_plan_path(_get_plan_id(plan))
        while (await self._client.call("GET", path, params={"pulses": False}))["status"] in ("queued", "running"):
            await asyncio.sleep(POLL_PERIOD_S)
        return (await self.plan(plan)).raise_if_failed()

    def stream(self, policy: Policy = "trim") -> "AsyncStream":
        """As `Display.stream`: `async with display.stream() as stream: await stream.send(heights_um)`."""
        return AsyncStream(self, policy)

    async def _submit(self, request: ApiRequest) -> Plan:
        answer = await self._client.call(request.method, request.path, request.idempotent, **request.arguments)
        return Plan.from_response(answer, await self.layout())

    async def _submit_and_wait(self, request: ApiRequest, wait: bool) -> Plan:
        self._may_emit = True
        plan = await self._submit(request)
        return await self.wait(plan) if wait else plan


class AsyncStream:
    """An open stream, once entered; as `Stream`."""

    def __init__(self, display: AsyncDisplay, policy: Policy) -> None:
        self._display = display
        self._endpoint: Endpoint = display._client.endpoint
        self._url = build_stream_url(self._endpoint, policy)
        self._next_frame = 0
        self._results = ResultBuffer()
        self._results_changed = asyncio.Condition()
        self._lost_before = 0
        self._exit_stack = AsyncExitStack()
        self._connection: ClientConnection | None = None
        self._reader_task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        await self._connect()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """As `Stream.close`."""
        await self._exit_stack.aclose()
        if self._reader_task is not None:
            await asyncio.gather(self._reader_task, return_exceptions=True)

    async def send(self, heights_um: HeightsLike) -> int:
        """As `Stream.send`."""
        number, self._next_frame = self._next_frame, self._next_frame + 1
        frame = encode_frame(number, convert_to_pixels(heights_um, await self._display.layout()))
        self._display._may_emit = True
        deadline_s = time.monotonic() + self._display._reconnect_timeout_s
        while True:
            try:
                if self._connection is not None:
                    await self._connection.send(frame)
                    return number
            except ConnectionClosed:
                self._connection = None
            try:
                await self._connect()
            except LinkError:
                if time.monotonic() >= deadline_s:
                    raise
                await asyncio.sleep(RETRY_S)

    async def results(self) -> list[FrameResult]:
        """As `Stream.results`."""
        async with self._results_changed:
            return self._results.drain()

    async def wait(self, frame: int | None = None, timeout_s: float = RESULT_TIMEOUT_S) -> FrameResult:
        """As `Stream.wait`."""
        number = self._next_frame - 1 if frame is None else frame
        try:
            async with asyncio.timeout(timeout_s), self._results_changed:
                while (result := self._results.find_final(number)) is None:
                    if number < self._lost_before:
                        raise LinkError(f"the link broke before it was heard what became of frame {number}")
                    await self._results_changed.wait()
        except TimeoutError:
            raise LinkError(f"nothing was heard of frame {number} for {timeout_s:g} s") from None
        return raise_if_failed(result)

    async def _connect(self) -> None:
        try:
            self._connection = await self._open_connection()
        except InvalidStatus as error:
            if error.response.status_code != 401 or not self._endpoint.renew_token():
                raise parse_refusal(error) from None
            self._connection = await self._open_connection()
        except CONNECTION_ERRORS as error:
            raise self._endpoint.build_unreachable_error(error) from None
        self._reader_task = asyncio.create_task(self._read(self._connection))

    async def _open_connection(self) -> ClientConnection:
        await self._exit_stack.aclose()
        connection = connect(
            self._url,
            additional_headers=self._endpoint.headers,
            sock=self._endpoint.open_unix_socket(),
            proxy=None,
            open_timeout=OPEN_TIMEOUT_S,
            compression=None,
        )
        return await self._exit_stack.enter_async_context(connection)

    async def _read(self, connection: ClientConnection) -> None:
        try:
            async for message in connection:
                async with self._results_changed:
                    self._results.add(message)
                    self._results_changed.notify_all()
        except ConnectionClosed:
            pass  # found out, and mended, by whoever sends
        finally:
            async with self._results_changed:
                self._lost_before = self._next_frame
                self._results_changed.notify_all()


def _get_plan_id(plan: Plan | str) -> str:
    return plan if isinstance(plan, str) else plan.plan_id
