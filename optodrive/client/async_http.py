"""Requests to a daemon that wait in the running event loop, with the limits of those that block."""

import asyncio
from typing import Any

import httpx

from optodrive.client import http
from optodrive.client.api_request import ApiRequest
from optodrive.client.endpoint import Endpoint


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
