"""WebSocket connections to a daemon."""

import logging
from contextlib import AsyncExitStack

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from optodrive.client.endpoint import Endpoint
from optodrive.client.problems import parse_problem
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


async def open_connection(
    endpoint: Endpoint,
    path: str,
    stack: AsyncExitStack,
    silence_max_s: float = SILENCE_MAX_S,
    open_timeout_s: float = OPEN_TIMEOUT_S,
) -> ClientConnection:
    """Open a WebSocket that the stack closes. Raise the error of a refusal, LinkError if no daemon can be reached.

    silence_max_s: after which the daemon counts as lost, which closes the connection
    open_timeout_s: longest wait for the answer to the handshake
    """

    async def open_once() -> ClientConnection:
        opening = connect(
            build_socket_url(endpoint, path),
            additional_headers=endpoint.headers,
            sock=endpoint.open_unix_socket(),
            proxy=None,
            open_timeout=open_timeout_s,
            close_timeout=CLOSE_TIMEOUT_S,
            ping_interval=silence_max_s / 2,
            ping_timeout=silence_max_s / 2,
            compression=None,
            logger=QUIET,
        )
        return await stack.enter_async_context(opening)

    endpoint.is_lost = False
    try:
        return await open_once()
    except InvalidStatus as error:
        _renew_token(endpoint, error)
        return await open_once()
    except CONNECTION_ERRORS as error:
        endpoint.is_lost = True
        raise endpoint.build_unreachable_error(error) from None


def _renew_token(endpoint: Endpoint, refused: InvalidStatus) -> None:
    """Read the token again after a refusal. Raise the error of the refusal if that does not help."""
    if refused.response.status_code != 401 or not endpoint.renew_token():
        raise parse_refusal(refused) from None


def parse_refusal(error: InvalidStatus) -> OptodriveError:
    """Build the error for a refused WebSocket handshake."""
    return parse_problem(error.response.status_code, bytes(error.response.body or b""))
