"""Exchanges with a daemon, stated once for blocking and for asynchronous callers.

They are coroutines, and `HttpIo` is their input and output. Where that blocks, a coroutine never waits for an event
loop: `run_blocking` runs it to its end in one step.
"""

import time
from collections.abc import Coroutine
from typing import Any, Protocol, TypeVar

import httpx

from optodrive.client.api_request import ApiRequest, Response
from optodrive.client.endpoint import Endpoint
from optodrive.core.errors import LinkError

RETRY_S = 0.1
RETRY_TIMEOUT_MIN_S = 0.3
"""Shortest time for the answer to a repeated request, however little is left of the time for repetitions."""
STOP_TIMEOUTS_S = 1.5, 1.0
"""Longest wait for the answer to each attempt to stop."""
STOP_LOST_TIMEOUTS_S = (1.0,)
"""The same at a daemon that has just not answered: the attempts before the stop failed already."""
NOT_SENT_ERRORS = (httpx.ConnectError, httpx.ConnectTimeout)
T = TypeVar("T")


class HttpIo(Protocol):
    """Requests to one daemon. Both kinds raise httpx.TransportError."""

    endpoint: Endpoint

    async def send(self, request: ApiRequest[Any], timeout_s: float | None) -> httpx.Response:
        """Send a request. timeout_s: longest wait for one that only reads, None for the usual one."""

    async def send_alone(self, request: ApiRequest[Any], timeout_s: float) -> httpx.Response:
        """Send a request on a connection of its own."""

    async def sleep(self, duration_s: float) -> None:
        """Wait for a time."""


def run_blocking(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine whose input and output blocks."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    raise RuntimeError("a blocking coroutine waits for an event loop")


class ExchangePolicy:
    """Retries: how often and how long a request is repeated.

    reconnect_timeout_s: how long a request that may be sent again is repeated, once the daemon has responded before
    """

    def __init__(self, http: HttpIo, reconnect_timeout_s: float = 0.0) -> None:
        self.endpoint = http.endpoint
        self._http = http
        self._reconnect_timeout_s = reconnect_timeout_s
        self._has_responded = False

    async def call(self, request: ApiRequest[Response]) -> Response:
        """Send a request and parse its response. Raise the error that a problem document describes.

        A request that is not idempotent is repeated only if it was certainly not received.
        """
        deadline_s = time.monotonic() + (self._reconnect_timeout_s if self._has_responded else 0.0)
        timeout_s = None
        while True:
            try:
                response = await self._http.send(request, timeout_s)
            except httpx.TransportError as error:
                left_s = deadline_s - time.monotonic()
                if left_s <= 0.0 or not (request.idempotent or isinstance(error, NOT_SENT_ERRORS)):
                    self.endpoint.is_lost = True
                    raise self.endpoint.build_unreachable_error(error) from None
                timeout_s = max(left_s, RETRY_TIMEOUT_MIN_S)
                await self._http.sleep(RETRY_S)
                continue
            self.endpoint.is_lost = False
            if response.status_code == 401 and self.endpoint.renew_token():
                continue
            self._has_responded = True
            return parse_response(request, response)

    async def stop(self, request: ApiRequest[Response]) -> Response:
        """Send the request to stop on new connections, since an open one may be broken unnoticed."""
        error: Exception = LinkError("not attempted")
        for timeout_s in STOP_LOST_TIMEOUTS_S if self.endpoint.is_lost else STOP_TIMEOUTS_S:
            try:
                response = await self._http.send_alone(request, timeout_s)
                if response.status_code == 401 and self.endpoint.renew_token():
                    response = await self._http.send_alone(request, timeout_s)
                return parse_response(request, response)
            except httpx.TransportError as transport_error:
                error = transport_error
        raise self.endpoint.build_stop_error(error)


def parse_response(request: ApiRequest[Response], response: httpx.Response) -> Response:
    """Parse a response as the request states.

    Raise the error that a problem document describes, LinkError for a response of something else than this API.
    """
    if response.is_success:
        try:
            return request.parse(response.content)
        except ValueError:
            raise LinkError(
                f"the answer to {request.method} {request.path} is not that of this API: a daemon of another version "
                "answers, or another program; after an upgrade, restart the daemon"
            ) from None
    from optodrive.client.problems import parse_problem  # its models take longer than a whole command without them

    raise parse_problem(response.status_code, response.content)
