"""WebSockets to a daemon, and the event loop in a thread of its own that serves callers who block.

A blocking stream or hold is an asynchronous one in such a thread. So one thread alone enters the OpenSSL of a
connection, which forbids concurrent calls: a WebSocket that one thread reads while another sends now and then loses a
handshake or a message.
"""

import asyncio
import logging
from collections.abc import Coroutine
from concurrent.futures import CancelledError
from contextlib import AsyncExitStack, suppress
from queue import SimpleQueue
from threading import Thread
from typing import Any, Generic, Protocol, Self, TypeVar

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from optodrive.client.exchange import Endpoint, run_blocking
from optodrive.client.problems import parse_problem
from optodrive.core.errors import OptodriveError
from optodrive.core.types.push_options import check_keywords

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


T = TypeVar("T")
END_MAX_S = 1.0


class LoopThread:
    """An event loop in a thread."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the loop, and return its result. After `close`, one that waits for nothing."""
        if self._loop.is_closed():
            return run_blocking(coroutine)
        call = _Call(coroutine)
        try:
            self._loop.call_soon_threadsafe(call.start)
            answer = call.answers.get()
        except BaseException:  # of the caller's thread, such as KeyboardInterrupt
            with suppress(RuntimeError):  # another thread has closed the loop
                self._loop.call_soon_threadsafe(call.cancel)
            raise
        if isinstance(answer, BaseException):
            raise answer
        return answer[0]

    def close(self) -> None:
        """End the loop once the coroutines of other callers have ended."""
        if not self._loop.is_closed():
            self.run(_end_others())
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()


class _Call(Generic[T]):
    """A coroutine that a loop runs for a caller in another thread.

    Ctrl-C may interrupt that thread anywhere. It therefore takes no lock that is written in Python, as that of a
    concurrent.futures.Future is: an interruption would leave it taken. Nor does it free a task, because asyncio is told
    of that by a callback, which would drop the exception.

    answers: of one entry, the result as a tuple or the exception
    """

    def __init__(self, coroutine: Coroutine[Any, Any, T]) -> None:
        self.answers: SimpleQueue[tuple[T] | BaseException] = SimpleQueue()
        self._coroutine = coroutine
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start the coroutine, in the thread of the loop."""
        self._task = asyncio.get_running_loop().create_task(self._run())

    def cancel(self) -> None:
        """Cancel the coroutine, in the thread of the loop, if it has not ended."""
        if self._task is not None:
            self._task.cancel()
        else:
            self._coroutine.close()

    async def _run(self) -> None:
        answer: tuple[T] | BaseException
        try:
            answer = (await self._coroutine,)
        except asyncio.CancelledError:
            answer = CancelledError()
        except BaseException as error:  # of any kind, for the caller
            answer = error
        self._task = None
        self.answers.put(answer)


class AsyncConnection(Protocol):
    """A connection that opens when entered."""

    async def __aenter__(self) -> object: ...

    async def close(self) -> None:
        """Close the connection."""


Connection = TypeVar("Connection", bound=AsyncConnection)


@check_keywords
class BlockingConnection(Generic[Connection]):
    """A connection whose loop runs in a thread of its own. Building it opens the connection."""

    def __init__(self, connection: Connection, name: str) -> None:
        self._connection, self._loop = connection, LoopThread(name)
        try:
            self._loop.run(connection.__aenter__())
        except BaseException:
            self.close()  # also after Ctrl-C while it opens: what was opened must not outlive this object
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection, and end its thread."""
        self._loop.run(self._connection.close())
        self._loop.close()


async def _end_others() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    if others:
        _, left = await asyncio.wait(others, timeout=END_MAX_S)
        for task in left:
            task.cancel()
