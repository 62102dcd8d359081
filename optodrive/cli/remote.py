"""Calls to a running daemon, with its problem documents turned back into errors."""

from typing import Any
from urllib.parse import urlsplit

import httpx

from optodrive.daemon.token import read_token
from optodrive.errors import InputError, LinkError, OptodriveError, RefusedError

TIMEOUT_S = 60.0
BAD_INPUT = (400, 404, 413, 422)


class Remote:
    """A running daemon, reached over HTTP."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise InputError("--url", url, "an address like http://127.0.0.1:8450")
        token = read_token(parts.port or 80)
        self._url = url
        self._client = httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}"}, timeout=TIMEOUT_S)

    def call(self, method: str, path: str, **request: Any) -> dict[str, Any]:
        """One request; the answer's JSON, or an error with the problem's own sentence."""
        try:
            response = self._client.request(method, path, **request)
        except httpx.TransportError as error:
            raise LinkError(f"no daemon answers at {self._url} ({error}); is `optodrive serve` running?") from None
        if response.is_success:
            answer: dict[str, Any] = response.json()
            return answer
        raise _error(response)


def _error(response: httpx.Response) -> OptodriveError:
    try:
        document = response.json()
        where, value, expected = document.get("where"), document.get("value"), document.get("expected")
        detail = str(document.get("detail", response.text))
    except (ValueError, AttributeError):
        return LinkError(f"the daemon answered {response.status_code} without a problem document")
    if response.status_code == 401:
        return InputError("token", "the one given", f"the daemon's own: {detail}", "bad_token")
    if response.status_code in BAD_INPUT:
        if where is not None and expected is not None:
            return InputError(str(where), _Verbatim(str(value)), str(expected), str(document.get("code")))
        return InputError("request", response.status_code, detail)
    return RefusedError(detail)


class _Verbatim:
    """A value whose repr was already made at the other end."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text
