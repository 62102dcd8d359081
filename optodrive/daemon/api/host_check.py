"""The check of a request's Host and Origin, which keeps pages of other sites from speaking to a server here."""

import base64
import binascii
import re
from collections.abc import Collection, Mapping, MutableMapping
from typing import Any, NamedTuple

from optodrive.daemon.responses.problem import Problem, build_problem

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
DEFAULT_PORTS = {"http": "80", "https": "443"}
AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[^\[\]:/?#@\s]+)(?::([0-9]{0,5}))?")
TEXT_MAX = 100
"""Characters of a header that a message quotes."""


def check_host_and_origin(headers: Mapping[str, str], hosts: Collection[str]) -> Problem | None:
    """Return why a request is refused: a Host that is none of `hosts`, or an Origin that is not this server's."""
    host = headers.get("host", "")
    own = _parse_authority(host)
    if own is None or own.name not in hosts:
        detail = (
            f"this server does not answer to host {host[:TEXT_MAX]!r}: its names besides loopback "
            "are those in daemon.hosts of a daemon's configuration, or in --page of a study"
        )
        return build_problem(421, "host_not_allowed", "Misdirected request", detail)
    origin = headers.get("origin")
    if origin is not None and not _is_same_origin(origin, own):
        detail = f"requests from origin {origin[:TEXT_MAX]!r} are not answered"
        return build_problem(403, "origin_not_allowed", "Origin not allowed", detail)
    return None


class _Authority(NamedTuple):
    name: str
    port: str


def _parse_authority(text: str) -> _Authority | None:
    match = AUTHORITY.fullmatch(text.strip().lower())
    return None if match is None else _Authority(match[1], match[2] or "")


def _is_same_origin(origin: str, own: _Authority) -> bool:
    """Return whether an Origin is the one at which the browser found this daemon, as its Host header states.

    https is possible only behind a proxy, for one of the configured names.
    """
    scheme, _, text = origin.strip().lower().partition("://")
    authority = _parse_authority(text)
    if authority is None or scheme not in DEFAULT_PORTS or (scheme == "https" and own.name in LOOPBACK_NAMES):
        return False
    default = DEFAULT_PORTS[scheme]
    return authority.name == own.name and (authority.port or default) == (own.port or default)


SUBPROTOCOL = "optodrive"
TOKEN_PREFIX = "bearer."  # noqa: S105 - no password


def is_websocket_request(headers: Mapping[str, str]) -> bool:
    """Return whether a request opens a WebSocket."""
    return headers.get("upgrade", "").lower() == "websocket"


def read_subprotocol_token(headers: Mapping[str, str]) -> str:
    """Return the token among the offered subprotocols, '' if there is none."""
    for offered in headers.get("sec-websocket-protocol", "").split(","):
        text = offered.strip()
        if text.startswith(TOKEN_PREFIX):
            encoded = text.removeprefix(TOKEN_PREFIX)
            try:
                return base64.urlsafe_b64decode(encoded + "=" * (-len(encoded) % 4)).decode()
            except (binascii.Error, ValueError):
                return ""
    return ""


def select_subprotocol(scope: MutableMapping[str, Any]) -> str | None:
    """Return the subprotocol to accept, None if the client offers none that is known."""
    return SUBPROTOCOL if SUBPROTOCOL in scope.get("subprotocols", ()) else None
