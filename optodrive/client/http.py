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
from optodrive.daemon.web.tokens import VARIABLE, read_token

Answer = dict[str, Any]
DEFAULT_URL = "http://127.0.0.1:8450"
TIMEOUT_S = 60.0
RETRY_S = 0.1
STOP_TRIES = 3
STOP_TIMEOUT_S = 3.0
BAD_INPUT = (400, 404, 413, 422)
NEVER_SENT = (httpx.ConnectError, httpx.ConnectTimeout)
BY_CODE: dict[str, type[OptodriveError]] = {
    "not_ready": NotReadyError,
    "board_fault": BoardFaultError,
    "link": LinkError,
}
STOP_UNHEARD = (
    "stop was not answered by {url} ({error}): what it plays may go on to its end; use the emergency stop or the key"
)


class Access:
    """Where the daemon is and what opens it. token: as given, from OPTODRIVE_TOKEN, or the file the daemon wrote.

    place: the address as given; url: what requests name; unix: the path of the daemon's Unix socket, if it is that
    """

    def __init__(self, place: str, token: str | None) -> None:
        parts = urlsplit(place)
        self.place = place.rstrip("/")
        self.unix = parts.path if parts.scheme == "unix" and not parts.netloc and parts.path != "/" else None
        if not self.unix and (parts.scheme not in ("http", "https") or not parts.hostname):
            raise InputError("--url", place, f"an address like {DEFAULT_URL} or unix:/run/optodrive/optodrive.sock")
        self.url = "http://localhost" if self.unix else self.place
        self._port = None if self.unix else parts.port or (443 if parts.scheme == "https" else 80)
        self._given = token
        self._token = token or read_token(self._port)

    @property
    def headers(self) -> dict[str, str]:
        """What every request carries."""
        return {"Authorization": f"Bearer {self._token}"}

    def renewed(self) -> bool:
        """Whether there is another token than the one just refused: a daemon that restarted has made a new one."""
        if self._given is not None:
            return False
        before, self._token = self._token, read_token(self._port)
        return self._token != before

    def socket(self) -> socket.socket | None:
        """A connection to the Unix socket, OSError where nobody answers; None where the daemon has an address."""
        if self.unix is None:
            return None
        link = socket.socket(socket.AF_UNIX)
        try:
            link.connect(self.unix)
        except OSError:
            link.close()
            raise
        return link

    def client(self, timeout_s: float) -> httpx.Client:
        """Connections to the daemon."""
        transport = httpx.HTTPTransport(uds=self.unix)
        return httpx.Client(base_url=self.url, transport=transport, timeout=timeout_s)

    def async_client(self, timeout_s: float) -> httpx.AsyncClient:
        """The same for asyncio."""
        transport = httpx.AsyncHTTPTransport(uds=self.unix)
        return httpx.AsyncClient(base_url=self.url, transport=transport, timeout=timeout_s)

    def unreachable(self, error: Exception) -> LinkError:
        """The error where nobody answers."""
        why = str(error) or type(error).__name__
        return LinkError(f"no daemon answers at {self.place} ({why}); is `optodrive serve` running?")

    def unheard(self, error: Exception) -> LinkError:
        """The error where stop was not answered."""
        return LinkError(STOP_UNHEARD.format(url=self.place, error=str(error) or type(error).__name__))


class Remote:
    """A running daemon. patience_s: how long what may be sent again is, once the daemon has answered before."""

    def __init__(self, url: str, token: str | None = None, patience_s: float = 0.0) -> None:
        self.access = Access(url, token)
        self._patience_s = patience_s
        self._known = False
        self._client = self.access.client(TIMEOUT_S)

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def call(self, method: str, path: str, safe: bool | None = None, **request: Any) -> Answer:
        """One request; the answer's JSON, or one of the package's errors with the problem's own sentence.

        safe: it may be sent again, as a GET may; else it is only where it surely was not heard
        """
        safe = method == "GET" if safe is None else safe
        until_s = time.monotonic() + (self._patience_s if self._known else 0.0)
        headers = request.pop("headers", {})
        while True:
            try:
                response = self._client.request(method, path, headers=headers | self.access.headers, **request)
            except httpx.TransportError as error:
                if time.monotonic() >= until_s or not (safe or isinstance(error, NEVER_SENT)):
                    raise self.access.unreachable(error) from None
                time.sleep(RETRY_S)
                continue
            if response.status_code == 401 and self.access.renewed():
                continue
            self._known = True
            return taken(response)

    def stop(self) -> Answer:
        """POST /v1/stop on a connection of its own, for an old one may be broken without knowing; thrice if need be."""
        error: Exception = LinkError("never tried")
        for _ in range(STOP_TRIES):
            try:
                with self.access.client(STOP_TIMEOUT_S) as fresh:
                    response = fresh.post("/v1/stop", headers=self.access.headers)
                    if response.status_code == 401 and self.access.renewed():
                        response = fresh.post("/v1/stop", headers=self.access.headers)
                    return taken(response)
            except httpx.TransportError as trouble:
                error = trouble
        raise self.access.unheard(error)


class AsyncRemote:
    """The same for asyncio."""

    def __init__(self, url: str, token: str | None = None, patience_s: float = 0.0) -> None:
        self.access = Access(url, token)
        self._patience_s = patience_s
        self._known = False
        self._client = self.access.async_client(TIMEOUT_S)

    async def close(self) -> None:
        """Close the connections."""
        await self._client.aclose()

    async def call(self, method: str, path: str, safe: bool | None = None, **request: Any) -> Answer:
        """As `Remote.call`."""
        safe = method == "GET" if safe is None else safe
        until_s = time.monotonic() + (self._patience_s if self._known else 0.0)
        headers = request.pop("headers", {})
        while True:
            try:
                response = await self._client.request(method, path, headers=headers | self.access.headers, **request)
            except httpx.TransportError as error:
                if time.monotonic() >= until_s or not (safe or isinstance(error, NEVER_SENT)):
                    raise self.access.unreachable(error) from None
                await asyncio.sleep(RETRY_S)
                continue
            if response.status_code == 401 and self.access.renewed():
                continue
            self._known = True
            return taken(response)

    async def stop(self) -> Answer:
        """As `Remote.stop`."""
        error: Exception = LinkError("never tried")
        for _ in range(STOP_TRIES):
            try:
                async with self.access.async_client(STOP_TIMEOUT_S) as fresh:
                    response = await fresh.post("/v1/stop", headers=self.access.headers)
                    if response.status_code == 401 and self.access.renewed():
                        response = await fresh.post("/v1/stop", headers=self.access.headers)
                    return taken(response)
            except httpx.TransportError as trouble:
                error = trouble
        raise self.access.unheard(error)


def taken(response: httpx.Response) -> Answer:
    """The answer's JSON; raises what a problem document tells."""
    if response.is_success:
        answer: Answer = response.json()
        return answer
    try:
        document = response.json()
    except ValueError:
        document = None
    raise problem_error(response.status_code, document)


def problem_error(status: int, document: object) -> OptodriveError:
    """An error of the package's own kinds from a problem document, which it keeps as `problem`."""
    if not isinstance(document, Mapping) or "detail" not in document:
        return LinkError(f"the daemon answered {status} without a problem document")
    error = _kind(status, document)
    error.problem = dict(document)
    error.code = str(document.get("code", error.code))
    return error


def _kind(status: int, document: Mapping[str, Any]) -> OptodriveError:
    detail, code = str(document["detail"]), str(document.get("code"))
    if status == 401:
        return InputError("token", "the one given", f"the daemon's own ({VARIABLE}, or the file it wrote): {detail}")
    if status in BAD_INPUT:
        where, expected = document.get("where"), document.get("expected")
        if where is not None and expected is not None:
            return InputError(str(where), _Verbatim(str(document.get("value"))), str(expected))
        return InputError("request", status, detail)
    if code == "over_budget":
        later_s = document["fits_later_s"]
        return OverBudgetError(
            detail, document["pixel"], document["cap"], document["margin_j"], inf if later_s is None else later_s
        )
    error = BY_CODE.get(code, RefusedError)(detail)
    if isinstance(error, RefusedError):
        error.admission = document.get("admission")
    return error


class _Verbatim:
    """A value whose repr was already made at the other end."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text
