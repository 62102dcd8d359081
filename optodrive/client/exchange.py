"""Exchanges with a daemon, stated once for blocking and for asynchronous callers.

They are coroutines, and `HttpIo` is their input and output. Where that blocks, a coroutine never waits for an event
loop: `run_blocking` runs it to its end in one step. Problem documents become this package's errors.
"""

import time
from collections.abc import Coroutine
from math import inf
from typing import Any, Protocol, TypeVar

import httpx
from pydantic import ValidationError

from optodrive.client.api_request import ApiRequest, Response
from optodrive.client.endpoint import Endpoint
from optodrive.core.errors import (
    BoardFaultError,
    BusyError,
    InputError,
    LinkError,
    NotReadyError,
    OptodriveError,
    OverBudgetError,
    RefusedError,
    StoppedError,
    Unquoted,
)
from optodrive.daemon.api.tokens import ENVIRONMENT_VARIABLE
from optodrive.daemon.responses.problem import Problem

INPUT_ERROR_STATUSES = (400, 404, 413, 422)
UPSTREAM_LOST = (502, 503, 504)
"""Statuses with which a proxy says that it does not reach the server behind it."""
ERROR_BY_CODE: dict[str, type[OptodriveError]] = {
    "not_ready": NotReadyError,
    "stopped": StoppedError,
    "busy": BusyError,
    "board_fault": BoardFaultError,
    "link": LinkError,
}


def parse_problem(status: int, body: bytes) -> OptodriveError:
    """Parse the body of an error response.

    Return LinkError if it is not a problem document. The daemon sends one with each error, so it came from a proxy.
    """
    try:
        problem = Problem.model_validate_json(body, extra="ignore")
    except ValidationError:
        if status in UPSTREAM_LOST:
            lost = f"a proxy answered {status}: the daemon behind it is not there"
            return LinkError(f"{lost}; is `optodrive serve` running?")
        return LinkError(f"{status} without a problem document: a proxy or another program answered, not the daemon")
    return build_error(problem)


def build_error(problem: Problem) -> OptodriveError:
    """Build the error that a problem document describes. The error keeps the document as `problem`."""
    error = _build_typed_error(problem)
    error.problem = problem.to_dict()
    error.code = problem.code
    if isinstance(error, RefusedError):
        error.feasibility = error.problem.get("feasibility")
    return error


def _build_typed_error(problem: Problem) -> OptodriveError:
    detail = problem.detail
    if problem.status == 401:
        reason = "" if problem.code == "bad_token" else f": {detail}"
        expected = f"one of this daemon's ({ENVIRONMENT_VARIABLE}, or the file that it names at its start){reason}"
        return InputError("token", Unquoted("another one"), expected)
    if problem.status in INPUT_ERROR_STATUSES:
        if problem.where is not None and problem.expected is not None:
            return InputError(problem.where, Unquoted(str(problem.value)), problem.expected)
        return InputError("request", problem.status, detail)
    if problem.pixel is not None and problem.cap is not None and problem.margin_j is not None:
        fits_after_s = inf if problem.fits_after_s is None else problem.fits_after_s
        return OverBudgetError(detail, problem.pixel, problem.cap, problem.margin_j, fits_after_s)
    return ERROR_BY_CODE.get(problem.code, RefusedError)(detail)


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
    from optodrive.client.exchange import parse_problem  # its models take longer than a whole command without them

    raise parse_problem(response.status_code, response.content)
