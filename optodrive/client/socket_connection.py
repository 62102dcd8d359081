"""WebSocket connections to a daemon, blocking and asynchronous."""

from contextlib import AsyncExitStack, ExitStack

import websockets.asyncio.client
import websockets.sync.client
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from optodrive.client.endpoint import Endpoint
from optodrive.client.problems import parse_problem
from optodrive.core.errors import OptodriveError

OPEN_TIMEOUT_S = 10.0
CONNECTION_ERRORS = (OSError, InvalidHandshake, ConnectionClosed, TimeoutError)


def build_socket_url(endpoint: Endpoint, path: str) -> str:
    """Build the address of a WebSocket. path: with its query."""
    return f"ws{endpoint.url.removeprefix('http')}{path}"


def open_connection(endpoint: Endpoint, path: str, stack: ExitStack) -> websockets.sync.client.ClientConnection:
    """Open a WebSocket that the stack closes. Raise the error of a refusal, LinkError if no daemon can be reached."""
    try:
        return stack.enter_context(_connect(endpoint, path))
    except InvalidStatus as error:
        if error.response.status_code != 401 or not endpoint.renew_token():
            raise parse_refusal(error) from None
        return stack.enter_context(_connect(endpoint, path))
    except CONNECTION_ERRORS as error:
        raise endpoint.build_unreachable_error(error) from None


def _connect(endpoint: Endpoint, path: str) -> websockets.sync.client.ClientConnection:
    return websockets.sync.client.connect(
        build_socket_url(endpoint, path),
        additional_headers=endpoint.headers,
        sock=endpoint.open_unix_socket(),
        proxy=None,
        open_timeout=OPEN_TIMEOUT_S,
        compression=None,
    )


async def open_async_connection(
    endpoint: Endpoint, path: str, stack: AsyncExitStack
) -> websockets.asyncio.client.ClientConnection:
    """Open a WebSocket as `open_connection` does."""
    try:
        return await stack.enter_async_context(_connect_async(endpoint, path))
    except InvalidStatus as error:
        if error.response.status_code != 401 or not endpoint.renew_token():
            raise parse_refusal(error) from None
        return await stack.enter_async_context(_connect_async(endpoint, path))
    except CONNECTION_ERRORS as error:
        raise endpoint.build_unreachable_error(error) from None


def _connect_async(endpoint: Endpoint, path: str) -> websockets.asyncio.client.connect:
    return websockets.asyncio.client.connect(
        build_socket_url(endpoint, path),
        additional_headers=endpoint.headers,
        sock=endpoint.open_unix_socket(),
        proxy=None,
        open_timeout=OPEN_TIMEOUT_S,
        compression=None,
    )


def parse_refusal(error: InvalidStatus) -> OptodriveError:
    """Build the error for a refused WebSocket handshake."""
    return parse_problem(error.response.status_code, bytes(error.response.body or b""))
