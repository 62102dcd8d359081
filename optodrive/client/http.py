"""Calls to a running daemon over HTTP; its problem documents become the package's own errors again."""

import asyncio
import socket
import time
from collections.abc import Mapping
from math import inf
from typing import Any
from urllib.parse import urlsplit

import httpx

from optodrive.core.errors import (
    BoardFaultError,
    InputError,
    LinkError,
    NotReadyError,
    OptodriveError,
    OverBudgetError,
    RefusedError,
)
from optodrive.daemon.web.tokens import TOKEN_VARIABLE, read_token

JsonObject = dict[str, Any]
DEFAULT_URL = "http://127.0.0.1:8450"
TIMEOUT_S = 60.0
RETRY_S = 0.1
STOP_ATTEMPTS = 3
STOP_TIMEOUT_S = 3.0
INPUT_ERROR_STATUSES = (400, 404, 413, 422)
NOT_SENT_ERRORS = (httpx.ConnectError, httpx.ConnectTimeout)
ERROR_BY_CODE: dict[str, type[OptodriveError]] = {
    "not_ready": NotReadyError,
    "board_fault": BoardFaultError,
    "link": LinkError,
}
STOP_UNANSWERED = (
    "stop was not answered by {url} ({error}): what it plays may go on to its end; use the emergency stop or the key"
)


class Endpoint:
    """Where the daemon is and what opens it. token: as given, from OPTODRIVE_TOKEN, or the file the daemon wrote.

    place: the address as given; url: what requests name; unix: the path of the daemon's Unix socket, if it is that
    """

    def __init__(self, address: str, token: str | None) -> None:
        parts = urlsplit(address)
        self.address = address.rstrip("/")
        self.unix_path = parts.path if parts.scheme == "unix" and not parts.netloc and parts.path != "/" else None
        if not self.unix_path and (parts.scheme not in ("http", "https") or not parts.hostname):
            raise InputError("--url", address, f"an address like {DEFAULT_URL} or unix:/run/optodrive/optodrive.sock")
        self.url = "http://localhost" if self.unix_path else self.address
        self._port = None if self.unix_path else parts.port or (443 if parts.scheme == "https" else 80)
        self._explicit_token = token
        self._token = token or read_token(self._port)

    @property
    def headers(self) -> dict[str, str]:
        """What every request carries."""
        return {"Authorization": f"Bearer {self._token}"}

    def renew_token(self) -> bool:
        """Whether there is another token than the one just refused: a daemon that restarted has made a new one."""
        if self._explicit_token is not None:
            return False
        previous, self._token = self._token, read_token(self._port)
        return self._token != previous

    def open_unix_socket(self) -> socket.socket | None:
        """A connection to the Unix socket, OSError where nobody answers; None where the daemon has an address."""
        if self.unix_path is None:
            return None
        link = socket.socket(socket.AF_UNIX)
        try:
            link.connect(self.unix_path)
        except OSError:
            link.close()
            raise
        return link

    def open_client(self, timeout_s: float) -> httpx.Client:
        """Connections to the daemon."""
        transport = httpx.HTTPTransport(uds=self.unix_path)
        return httpx.Client(base_url=self.url, transport=transport, timeout=timeout_s)

    def open_async_client(self, timeout_s: float) -> httpx.AsyncClient:
        """The same for asyncio."""
        transport = httpx.AsyncHTTPTransport(uds=self.unix_path)
        return httpx.AsyncClient(base_url=self.url, transport=transport, timeout=timeout_s)

    def build_unreachable_error(self, error: Exception) -> LinkError:
        """The error where nobody answers."""
        cause = str(error) or type(error).__name__
        return LinkError(f"no daemon answers at {self.address} ({cause}); is `optodrive serve` running?")

    def build_stop_error(self, error: Exception) -> LinkError:
        """The error where stop was not answered."""
        return LinkError(STOP_UNANSWERED.format(url=self.address, error=str(error) or type(error).__name__))


class DaemonClient:
    """A running daemon. patience_s: how long what may be sent again is, once the daemon has answered before."""

    def __init__(self, url: str, token: str | None = None, reconnect_timeout_s: float = 0.0) -> None:
        self.endpoint = Endpoint(url, token)
        self._reconnect_timeout_s = reconnect_timeout_s
        self._has_responded = False
        self._client = self.endpoint.open_client(TIMEOUT_S)

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def call(self, method: str, path: str, idempotent: bool | None = None, **request: Any) -> JsonObject:
        """One request; the answer's JSON, or one of the package's errors with the problem's own sentence.

        safe: it may be sent again, as a GET may; else it is only where it surely was not heard
        """
        idempotent = method == "GET" if idempotent is None else idempotent
        deadline_s = time.monotonic() + (self._reconnect_timeout_s if self._has_responded else 0.0)
        headers = request.pop("headers", {})
        while True:
            try:
                response = self._client.request(method, path, headers=headers | self.endpoint.headers, **request)
            except httpx.TransportError as error:
                if time.monotonic() >= deadline_s or not (idempotent or isinstance(error, NOT_SENT_ERRORS)):
                    raise self.endpoint.build_unreachable_error(error) from None
                time.sleep(RETRY_S)
                continue
            if response.status_code == 401 and self.endpoint.renew_token():
                continue
            self._has_responded = True
            return parse_response(response)

    def stop(self) -> JsonObject:
        """POST /v1/stop on a connection of its own, for an old one may be broken without knowing; thrice if need be."""
        error: Exception = LinkError("never tried")
        for _ in range(STOP_ATTEMPTS):
            try:
                with self.endpoint.open_client(STOP_TIMEOUT_S) as client:
                    response = client.post("/v1/stop", headers=self.endpoint.headers)
                    if response.status_code == 401 and self.endpoint.renew_token():
                        response = client.post("/v1/stop", headers=self.endpoint.headers)
                    return parse_response(response)
            except httpx.TransportError as transport_error:
                error = transport_error
        raise self.endpoint.build_stop_error(error)


class AsyncDaemonClient:
    """The same for asyncio."""

    def __init__(self, url: str, token: str | None = None, reconnect_timeout_s: float = 0.0) -> None:
        self.endpoint = Endpoint(url, token)
        self._reconnect_timeout_s = reconnect_timeout_s
        self._has_responded = False
        self._client = self.endpoint.open_async_client(TIMEOUT_S)

    async def close(self) -> None:
        """Close the connections."""
        await self._client.aclose()

    async def call(self, method: str, path: str, idempotent: bool | None = None, **request: Any) -> JsonObject:
        """As `Remote.call`."""
        idempotent = method == "GET" if idempotent is None else idempotent
        deadline_s = time.monotonic() + (self._reconnect_timeout_s if self._has_responded else 0.0)
        headers = request.pop("headers", {})
        while True:
            try:
                response = await self._client.request(method, path, headers=headers | self.endpoint.headers, **request)
            except httpx.TransportError as error:
                if time.monotonic() >= deadline_s or not (idempotent or isinstance(error, NOT_SENT_ERRORS)):
                    raise self.endpoint.build_unreachable_error(error) from None
                await asyncio.sleep(RETRY_S)
                continue
            if response.status_code == 401 and self.endpoint.renew_token():
                continue
            self._has_responded = True
            return parse_response(response)

    async def stop(self) -> JsonObject:
        """As `Remote.stop`."""
        error: Exception = LinkError("never tried")
        for _ in range(STOP_ATTEMPTS):
            try:
                async with self.endpoint.open_async_client(STOP_TIMEOUT_S) as client:
                    response = await client.post("/v1/stop", headers=self.endpoint.headers)
                    if response.status_code == 401 and self.endpoint.renew_token():
                        response = await client.post("/v1/stop", headers=self.endpoint.headers)
                    return parse_response(response)
            except httpx.TransportError as transport_error:
                error = transport_error
        raise self.endpoint.build_stop_error(error)


def parse_response(response: httpx.Response) -> JsonObject:
    """The answer's JSON; raises what a problem document tells."""
    if response.is_success:
        content: JsonObject = response.json()
        return content
    try:
        document = response.json()
    except ValueError:
        document = None
    raise build_error(response.status_code, document)


def build_error(status: int, document: object) -> OptodriveError:
    """An error of the package's own kinds from a problem document, which it keeps as `problem`."""
    if not isinstance(document, Mapping) or "detail" not in document:
        return LinkError(f"the daemon answered {status} without a problem document")
    error = _build_typed_error(status, document)
    error.problem = dict(document)
    error.code = str(document.get("code", error.code))
    return error


def _build_typed_error(status: int, document: Mapping[str, Any]) -> OptodriveError:
    detail, code = str(document["detail"]), str(document.get("code"))
    if status == 401:
        return InputError(
            "token", "the one given", f"the daemon's own ({TOKEN_VARIABLE}, or the file it wrote): {detail}"
        )
    if status in INPUT_ERROR_STATUSES:
        where, expected = document.get("where"), document.get("expected")
        if where is not None and expected is not None:
            return InputError(str(where), _PreformattedRepr(str(document.get("value"))), str(expected))
        return InputError("request", status, detail)
    if code == "over_budget":
        fits_after_s = document["fits_later_s"]
        return OverBudgetError(
            detail,
            document["pixel"],
            document["cap"],
            document["margin_j"],
            inf if fits_after_s is None else fits_after_s,
        )
    error = ERROR_BY_CODE.get(code, RefusedError)(detail)
    if isinstance(error, RefusedError):
        error.feasibility = document.get("feasibility")
    return error


class _PreformattedRepr:
    """A value whose repr was already made at the other end."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text
