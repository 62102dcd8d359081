"""Requests to a daemon that block."""

import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from threading import Thread
from typing import Any

import httpx

from optodrive.client.api_request import ApiRequest, Response
from optodrive.client.exchange import Endpoint, ExchangePolicy, run_blocking
from optodrive.core.errors import NotReadyError

READ_TIMEOUT_S = 2.5
"""Longest wait for what the daemon only reads."""
TIMEOUT_S = 60.0
"""Longest wait for an action, while the daemon shows that it is alive."""
PROBE_PERIOD_S = 0.5
PROBE_TIMEOUT_S = 1.5
"""Half as long again as a web process may be silent before the board goes dark."""
PROBE: dict[str, Any] = {"method": "GET", "url": "/v1/health", "timeout": PROBE_TIMEOUT_S}


class BlockingHttp:
    """Requests that block. Their coroutines never wait.

    timeout_s: longest wait for a part of an answer, None for the usual one
    """

    def __init__(self, endpoint: Endpoint, timeout_s: float | None = None) -> None:
        self.endpoint = endpoint
        self._timeout_s = TIMEOUT_S if timeout_s is None else timeout_s
        self._client = endpoint.open_client(self._timeout_s)

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def require_open(self) -> None:
        """Raise NotReadyError after `close`."""
        require_open(self._client)

    async def sleep(self, duration_s: float) -> None:
        """See `HttpIo`."""
        time.sleep(duration_s)

    async def send_alone(self, request: ApiRequest[Any], timeout_s: float) -> httpx.Response:
        """See `HttpIo`."""
        with self.endpoint.open_client(timeout_s) as client:
            return client.request(**build_arguments(request, self.endpoint))

    async def send(self, request: ApiRequest[Any], timeout_s: float | None) -> httpx.Response:
        """See `HttpIo`. For an action that takes long, watch whether the daemon answers others meanwhile."""
        self.require_open()
        arguments = build_arguments(request, self.endpoint)
        if request.method == "GET":
            return self._client.request(**arguments, timeout=min(limit_read_s(timeout_s), self._timeout_s))
        future: Future[httpx.Response] = Future()
        Thread(target=_complete, args=(future, partial(self._client.request, **arguments)), daemon=True).start()
        while True:
            with suppress(TimeoutError):
                return future.result(PROBE_PERIOD_S)
            self._client.request(**PROBE)


class DaemonClient:
    """Blocking calls without a display, for commands."""

    def __init__(self, url: str, token: str | None = None, timeout_s: float | None = None) -> None:
        self.endpoint = Endpoint(url, token)
        self._policy = ExchangePolicy(BlockingHttp(self.endpoint, timeout_s))

    def call(self, request: ApiRequest[Response]) -> Response:
        """Run `ExchangePolicy.call`."""
        return run_blocking(self._policy.call(request))


def _complete(future: "Future[httpx.Response]", send: Callable[[], httpx.Response]) -> None:
    try:
        future.set_result(send())
    except BaseException as error:  # of the caller's thread
        future.set_exception(error)


def require_open(client: httpx.Client | httpx.AsyncClient) -> None:
    """Raise NotReadyError if the HTTP client is closed."""
    if client.is_closed:
        raise NotReadyError("this display is closed, and only `stop` works; open another `Display`")


def limit_read_s(timeout_s: float | None) -> float:
    """Return the longest wait for a request that only reads, s."""
    return READ_TIMEOUT_S if timeout_s is None else min(READ_TIMEOUT_S, timeout_s)


def build_arguments(request: ApiRequest[Any], endpoint: Endpoint) -> dict[str, Any]:
    """Build the arguments of the HTTP client's `request`."""
    arguments = dict(request.arguments)
    headers = arguments.pop("headers", {}) | endpoint.headers
    return {"method": request.method, "url": request.path, "headers": headers, **arguments}
