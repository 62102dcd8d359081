"""The token of a WebSocket whose client cannot send a header: browsers can only offer subprotocols.

The client offers `optodrive` and `bearer.` with the token in base64url, and the server selects `optodrive`.
"""

import base64
import binascii
from collections.abc import Mapping, MutableMapping
from typing import Any

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
