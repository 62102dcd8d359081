"""WebSocket connections to a daemon, blocking and asynchronous."""

import logging
from contextlib import AsyncExitStack, ExitStack
from typing import Any

import websockets.asyncio.client
import websockets.sync.client
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from optodrive.client.endpoint import Endpoint
from optodrive.client.problems import parse_problem
from optodrive.client.tls_socket import build_tls_context
from optodrive.core.errors import OptodriveError

OPEN_TIMEOUT_S = 2.5
CLOSE_TIMEOUT_S = 0.5
SILENCE_MAX_S = 40.0
"""Longest silence of a daemon to which a client may send faster than it reads."""
QUIET = logging.getLogger("optodrive.client.socket")
"""Logger of the connections: what it would say with a traceback, such as the loss of the daemon, is an error here."""
QUIET.addHandler(logging.NullHandler())
QUIET.propagate = False
CONNECTION_ERRORS = (OSError, InvalidHandshake, ConnectionClosed, TimeoutError)


def build_socket_url(endpoint: Endpoint, path: str) -> str:
    """Build the address of a WebSocket. path: with its query."""
    return f"ws{endpoint.url.removeprefix('http')}{path}"


def open_connection(
    endpoint: Endpoint,
    path: str,
    stack: ExitStack,
    silence_max_s: float = SILENCE_MAX_S,
    open_timeout_s: float = OPEN_TIMEOUT_S,
) -> websockets.sync.client.ClientConnection:
    """Open a WebSocket that the stack closes. Raise the error of a refusal, LinkError if no daemon can be reached.

    silence_max_s: after which the daemon counts as lost, which closes the connection
    open_timeout_s: longest wait for the answer to the handshake
    """

    def connect() -> websockets.sync.client.ClientConnection:
        options = _build_options(endpoint, silence_max_s, open_timeout_s)
        if endpoint.url.startswith("https"):
            options["ssl"] = build_tls_context()
        opened: websockets.sync.client.ClientConnection = websockets.sync.client.connect(
            build_socket_url(endpoint, path), **options
        )
        return stack.enter_context(opened)

    endpoint.is_lost = False
    try:
        return connect()
    except InvalidStatus as error:
        _renew_token(endpoint, error)
        return connect()
    except CONNECTION_ERRORS as error:
        endpoint.is_lost = True
        raise endpoint.build_unreachable_error(error) from None


async def open_async_connection(
    endpoint: Endpoint,
    path: str,
    stack: AsyncExitStack,
    silence_max_s: float = SILENCE_MAX_S,
    open_timeout_s: float = OPEN_TIMEOUT_S,
) -> websockets.asyncio.client.ClientConnection:
    """Open a WebSocket as `open_connection` does."""

    async def connect() -> websockets.asyncio.client.ClientConnection:
        options = _build_options(endpoint, silence_max_s, open_timeout_s)
        opening = websockets.asyncio.client.connect(build_socket_url(endpoint, path), **options)
        return await stack.enter_async_context(opening)

    endpoint.is_lost = False
    try:
        return await connect()
    except InvalidStatus as error:
        _renew_token(endpoint, error)
        return await connect()
    except CONNECTION_ERRORS as error:
        endpoint.is_lost = True
        raise endpoint.build_unreachable_error(error) from None


def _build_options(endpoint: Endpoint, silence_max_s: float, open_timeout_s: float) -> dict[str, Any]:
    """Build the options of a new connection for both kinds."""
    return {
        "additional_headers": endpoint.headers,
        "sock": endpoint.open_unix_socket(),
        "proxy": None,
        "open_timeout": open_timeout_s,
        "close_timeout": CLOSE_TIMEOUT_S,
        "ping_interval": silence_max_s / 2,
        "ping_timeout": silence_max_s / 2,
        "compression": None,
        "logger": QUIET,
    }


def _renew_token(endpoint: Endpoint, refused: InvalidStatus) -> None:
    """Read the token again after a refusal. Raise the error of the refusal if that does not help."""
    if refused.response.status_code != 401 or not endpoint.renew_token():
        raise parse_refusal(refused) from None


def parse_refusal(error: InvalidStatus) -> OptodriveError:
    """Build the error for a refused WebSocket handshake."""
    return parse_problem(error.response.status_code, bytes(error.response.body or b""))
