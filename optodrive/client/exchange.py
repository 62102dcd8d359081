"""Exchanges with a daemon, stated once for blocking and for asynchronous callers.

They are coroutines, and `HttpIo` is their input and output. Where that blocks, a coroutine never waits for an event
loop: `run_blocking` runs it to its end in one step.
"""

import socket
import time
from collections.abc import Coroutine
from typing import Any, Protocol, TypeVar
from urllib.parse import urlsplit

import httpx

from optodrive.client.api_request import ApiRequest, Response
from optodrive.core.daemon_url import DEFAULT_URL
from optodrive.core.errors import InputError, LinkError
from optodrive.daemon.api.tokens import read_token

PROBE_TIMEOUT_S = 2.0
STOP_UNANSWERED = (
    "stop was not answered by {url} ({error}): the running plan may go on to its end; use the emergency stop or the key"
)
TLS_REMEDIES = {
    "WRONG_VERSION_NUMBER": "without TLS: state http:// in place of https://",
    "CERTIFICATE_VERIFY_FAILED": "its certificate does not hold here: name the file of its authority by SSL_CERT_FILE",
}
"""What to do about a failure of TLS, by OpenSSL's name of it."""


class Endpoint:
    """The daemon's address, and the token: as given, from OPTODRIVE_TOKEN, or from the file that the daemon wrote.

    address: as given; url: base of the requests; unix_path: the daemon's Unix socket, None for a TCP address
    is_lost: whether the last request was given up because nobody answered
    """

    def __init__(self, address: str, token: str | None) -> None:
        parts = urlsplit(address)
        self.address = address.rstrip("/")
        self.unix_path = parts.path if parts.scheme == "unix" and not parts.netloc and parts.path != "/" else None
        if not self.unix_path and (parts.scheme not in ("http", "https") or not parts.hostname):
            raise InputError("url", address, f"an address like {DEFAULT_URL} or unix:/run/optodrive/optodrive.sock")
        self.url = "http://localhost" if self.unix_path else self.address
        self._port = None if self.unix_path else parts.port or (443 if parts.scheme == "https" else 80)
        self._has_certificate = parts.scheme == "https"  # loading what verifies it takes as long as many requests
        self.is_lost = False
        self._explicit_token = token
        self._token = token or self._read_token()

    @property
    def headers(self) -> dict[str, str]:
        """The headers of every request."""
        return {"Authorization": f"Bearer {self._token}"}

    def renew_token(self) -> bool:
        """Read the token again after a refusal and return whether it changed. A restarted daemon has a new one."""
        if self._explicit_token is not None:
            return False
        previous, self._token = self._token, self._read_token()
        return self._token != previous

    def _read_token(self) -> str:
        """Read the token. Raise InputError if none is readable, LinkError if that is because no daemon runs."""
        try:
            return read_token(self._port)
        except InputError:
            try:
                self._probe()
            except OSError as error:
                raise self.build_unreachable_error(error) from None
            raise

    def _probe(self) -> None:
        """Connect and close. Raise OSError if nobody listens."""
        if self.unix_path is not None:
            with socket.socket(socket.AF_UNIX) as connection:
                connection.settimeout(PROBE_TIMEOUT_S)
                connection.connect(self.unix_path)
        else:
            host = str(urlsplit(self.address).hostname)
            socket.create_connection((host, self._port), PROBE_TIMEOUT_S).close()

    def open_unix_socket(self) -> socket.socket | None:
        """Connect to the Unix socket, or return None for a TCP address. Raise OSError if the connection is refused."""
        if self.unix_path is None:
            return None
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.settimeout(PROBE_TIMEOUT_S)  # a daemon that is suspended accepts until its backlog is full
            connection.connect(self.unix_path)
            connection.settimeout(None)
        except OSError:
            connection.close()
            raise
        return connection

    def open_client(self, timeout_s: float | None) -> httpx.Client:
        """Open an HTTP client for the daemon."""
        transport = httpx.HTTPTransport(uds=self.unix_path, verify=self._has_certificate)
        return httpx.Client(base_url=self.url, transport=transport, timeout=timeout_s)

    def open_async_client(self, timeout_s: float | None) -> httpx.AsyncClient:
        """Open an asynchronous HTTP client for the daemon."""
        transport = httpx.AsyncHTTPTransport(uds=self.unix_path, verify=self._has_certificate)
        return httpx.AsyncClient(base_url=self.url, transport=transport, timeout=timeout_s)

    def build_unreachable_error(self, error: Exception) -> LinkError:
        """Build the error for a daemon that does not answer."""
        cause = (isinstance(error, OSError) and error.strerror) or str(error) or type(error).__name__
        for name, remedy in TLS_REMEDIES.items():
            if name in cause:
                return LinkError(f"{self.address} answers, but {remedy} ({cause})")
        return LinkError(f"no daemon answers at {self.address} ({cause}); is `optodrive serve` running?")

    def build_stop_error(self, error: Exception) -> LinkError:
        """Build the error for a stop that is not answered."""
        return LinkError(STOP_UNANSWERED.format(url=self.address, error=str(error) or type(error).__name__))


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
