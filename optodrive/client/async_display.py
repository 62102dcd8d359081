"""A display, controlled with asyncio: the methods of `Display` as coroutines."""

import asyncio
from types import TracebackType
from typing import Any, Self

import httpx

from optodrive.client import http
from optodrive.client.api_request import ApiRequest
from optodrive.client.exchange import Endpoint
from optodrive.client.fingers import AsyncFingers
from optodrive.client.hold import AsyncHold
from optodrive.client.operations import RECONNECT_TIMEOUT_S, DisplayOperations
from optodrive.client.stream import AsyncStream
from optodrive.core.daemon_url import check_environment, read_default_url
from optodrive.core.errors import OptodriveError
from optodrive.core.types.push_options import Policy, check_keywords
from optodrive.daemon.responses.state import StateReport


class AsyncHttp:
    """Requests that wait in the running event loop."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self._client = endpoint.open_async_client(http.TIMEOUT_S)

    async def close(self) -> None:
        """Close the connections."""
        await self._client.aclose()

    def require_open(self) -> None:
        """Raise NotReadyError after `close`."""
        http.require_open(self._client)

    async def sleep(self, duration_s: float) -> None:
        """See `HttpIo`."""
        await asyncio.sleep(duration_s)

    async def send_alone(self, request: ApiRequest[Any], timeout_s: float) -> httpx.Response:
        """See `HttpIo`."""
        async with self.endpoint.open_async_client(timeout_s) as client:
            return await client.request(**http.build_arguments(request, self.endpoint))

    async def send(self, request: ApiRequest[Any], timeout_s: float | None) -> httpx.Response:
        """See `BlockingHttp.send`."""
        self.require_open()
        arguments = http.build_arguments(request, self.endpoint)
        if request.method == "GET":
            return await self._client.request(**arguments, timeout=http.limit_read_s(timeout_s))
        task = asyncio.ensure_future(self._client.request(**arguments))
        try:
            while not (await asyncio.wait({task}, timeout=http.PROBE_PERIOD_S))[0]:
                await self._client.request(**http.PROBE)
            return task.result()
        finally:
            task.cancel()


@check_keywords
class AsyncDisplay(DisplayOperations):
    """A display behind a running daemon, as an asynchronous context manager. See `Display`."""

    def __init__(
        self, url: str | None = None, token: str | None = None, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
    ) -> None:
        check_environment()
        self._client = AsyncHttp(Endpoint(url or read_default_url(), token))
        super().__init__(self._client, reconnect_timeout_s)
        self._reconnect_timeout_s = reconnect_timeout_s
        self._hold: AsyncHold | None = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self.may_emit:
                await asyncio.shield(self.stop())  # a cancelled task must stop what it started, too
        except OptodriveError as stop_error:
            if error is None:
                raise
            error.add_note(f"optodrive: {stop_error}")
        finally:
            await self.close()

    async def close(self) -> None:
        """See `Display.close`."""
        if self._hold is not None:
            await self._hold.close()
        await self._client.close()

    async def arm(self, *, hold: bool = False) -> StateReport:
        """Arm the board as `Display.arm` does. A loop that is blocked for a second disarms, too."""
        if not hold:
            return await super().arm()
        self._record_emission()
        held = AsyncHold(self._client.endpoint)
        await held.__aenter__()
        self._hold = held
        return await self.state()

    def stream(self, policy: Policy = "trim", *, standing: bool = False, touched_only: bool = False) -> AsyncStream:
        """Open a stream as `Display.stream` does: `async with display.stream() as stream: await stream.send(…)`."""
        frames = (policy, standing, touched_only)
        return AsyncStream(
            self._client.endpoint, self.layout, *frames, self._reconnect_timeout_s, self._record_emission
        )

    def fingers(self) -> AsyncFingers:
        """Open a connection as `Display.fingers` does: `async with display.fingers() as fingers`."""
        return AsyncFingers(self._client.endpoint)

    def _record_emission(self) -> None:
        self._client.require_open()
        self.may_emit = True
