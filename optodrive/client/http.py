"""HTTP clients that run exchanges with a daemon, blocking and asynchronous."""

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from threading import Thread
from typing import Any

import httpx

from optodrive.client.endpoint import Endpoint
from optodrive.client.exchange import Exchange, ExchangePolicy, Pause, Step, T, Transmission
from optodrive.client.requests import ApiRequest, Response
from optodrive.core.errors import NotReadyError
from optodrive.daemon.responses.state import StateReport

READ_TIMEOUT_S = 2.5
"""Longest wait for what the daemon only reads."""
TIMEOUT_S = 60.0
"""Longest wait for an action, while the daemon shows that it is alive."""
PROBE_PERIOD_S = 0.5
PROBE_TIMEOUT_S = 1.5
"""Half as long again as a web process may be silent before the board goes dark."""
PROBE: dict[str, Any] = {"method": "GET", "url": "/v1/health", "timeout": PROBE_TIMEOUT_S}


class DaemonClient:
    """A blocking client. `policy` states the retries.

    timeout_s: longest wait for a part of an answer
    """

    def __init__(
        self, url: str, token: str | None = None, reconnect_timeout_s: float = 0.0, timeout_s: float = TIMEOUT_S
    ) -> None:
        self.policy = ExchangePolicy(Endpoint(url, token), reconnect_timeout_s)
        self._timeout_s = timeout_s
        self._client = self.policy.endpoint.open_client(timeout_s)

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def require_open(self) -> None:
        """Raise NotReadyError after `close`."""
        _require_open(self._client)

    def call(self, request: ApiRequest[Response]) -> Response:
        """Run `ExchangePolicy.call`."""
        return self.run(self.policy.call(request))

    def stop(self) -> StateReport:
        """Run `ExchangePolicy.stop`."""
        return self.run(self.policy.stop())

    def run(self, exchange: Exchange[T]) -> T:
        """Run an exchange and return its result."""
        try:
            step = next(exchange)
            while True:
                try:
                    response = self._perform(step)
                except httpx.TransportError as error:
                    step = exchange.throw(error)
                else:
                    step = exchange.send(response)
        except StopIteration as end:
            result: T = end.value
            return result

    def _perform(self, step: Step) -> httpx.Response | None:
        if isinstance(step, Pause):
            time.sleep(step.duration_s)
            return None
        if step.on_new_connection:
            with self.policy.endpoint.open_client(step.timeout_s) as client:
                return client.request(**_build_arguments(step.request, self.policy.endpoint))
        self.require_open()
        arguments = _build_arguments(step.request, self.policy.endpoint)
        if step.request.method == "GET":
            return self._client.request(**arguments, timeout=min(_limit_read_s(step), self._timeout_s))
        return self._request_watched(arguments)

    def _request_watched(self, arguments: dict[str, Any]) -> httpx.Response:
        """Send a request that may take long. Raise TransportError as soon as the daemon no longer answers others."""
        future: Future[httpx.Response] = Future()
        Thread(target=_complete, args=(future, partial(self._client.request, **arguments)), daemon=True).start()
        while True:
            with suppress(TimeoutError):
                return future.result(PROBE_PERIOD_S)
            self._client.request(**PROBE)


def _complete(future: "Future[httpx.Response]", send: Callable[[], httpx.Response]) -> None:
    try:
        future.set_result(send())
    except BaseException as error:  # of the caller's thread
        future.set_exception(error)


class AsyncDaemonClient:
    """An asynchronous client. `policy` states the retries."""

    def __init__(self, url: str, token: str | None = None, reconnect_timeout_s: float = 0.0) -> None:
        self.policy = ExchangePolicy(Endpoint(url, token), reconnect_timeout_s)
        self._client = self.policy.endpoint.open_async_client(TIMEOUT_S)

    async def close(self) -> None:
        """Close the connections."""
        await self._client.aclose()

    def require_open(self) -> None:
        """Raise NotReadyError after `close`."""
        _require_open(self._client)

    async def run(self, exchange: Exchange[T]) -> T:
        """Run an exchange and return its result."""
        try:
            step = next(exchange)
            while True:
                try:
                    response = await self._perform(step)
                except httpx.TransportError as error:
                    step = exchange.throw(error)
                else:
                    step = exchange.send(response)
        except StopIteration as end:
            result: T = end.value
            return result

    async def _perform(self, step: Step) -> httpx.Response | None:
        if isinstance(step, Pause):
            await asyncio.sleep(step.duration_s)
            return None
        if step.on_new_connection:
            async with self.policy.endpoint.open_async_client(step.timeout_s) as client:
                return await client.request(**_build_arguments(step.request, self.policy.endpoint))
        self.require_open()
        arguments = _build_arguments(step.request, self.policy.endpoint)
        if step.request.method == "GET":
            return await self._client.request(**arguments, timeout=_limit_read_s(step))
        task = asyncio.ensure_future(self._client.request(**arguments))
        try:
            while not (await asyncio.wait({task}, timeout=PROBE_PERIOD_S))[0]:
                await self._client.request(**PROBE)
            return task.result()
        finally:
            task.cancel()


def _require_open(client: httpx.Client | httpx.AsyncClient) -> None:
    if client.is_closed:
        raise NotReadyError("this display is closed, and only `stop` works; open another `Display`")


def _limit_read_s(step: Transmission) -> float:
    return READ_TIMEOUT_S if step.timeout_s is None else min(READ_TIMEOUT_S, step.timeout_s)


def _build_arguments(request: ApiRequest[Any], endpoint: Endpoint) -> dict[str, Any]:
    arguments = dict(request.arguments)
    headers = arguments.pop("headers", {}) | endpoint.headers
    return {"method": request.method, "url": request.path, "headers": headers, **arguments}
