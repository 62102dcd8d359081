"""The web server: uvicorn with bounded connections, STOP first, and signal handling left to the daemon."""

import asyncio
import socket
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager

import uvicorn

from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.request_limits import App
from optodrive.daemon.api.tokens import Token
from optodrive.daemon.server.acceptor_client import AcceptorClient
from optodrive.daemon.server.bounded_protocols import MESSAGE_MAX_BYTES, BoundedHttp, BoundedWebSocket
from optodrive.daemon.server.connection_queue import WAIT_MAX_S, Waiting
from optodrive.daemon.server.connections import PHASE_MAX_S, Connections, Rank, parse_head, rank_request
from optodrive.daemon.server.listeners import raise_descriptor_limit
from optodrive.daemon.server.stop_first_selector import ServerState, StopFirstSelector

RETRY_S = 0.02
"""Interval at which a connection is tried again for which there was no room."""


class ConnectionOpener:
    """Opens connections, and confirms them to the acceptor, which then hands over the next ones."""

    def __init__(
        self,
        acceptor: AcceptorClient,
        selector: StopFirstSelector,
        connections: Connections,
        create_protocol: Callable[[], asyncio.Protocol],
    ) -> None:
        self._acceptor = acceptor
        self._selector = selector
        self._connections = connections
        self._create_protocol = create_protocol
        self._loop = asyncio.get_running_loop()
        self._opening: set[asyncio.Task[object]] = set()
        self._held: dict[asyncio.TimerHandle, Waiting] = {}
        acceptor.on_connection = self._receive

    def close(self) -> None:
        """Take no more connections, and close those that wait."""
        self._acceptor.close()
        for handle, waiting in self._held.items():
            handle.cancel()
            waiting.sock.close()
        self._held.clear()

    def _receive(self, waiting: Waiting) -> None:
        """Open a connection, or hold it while there is no room. The acceptor may send another one in the next turn."""
        if self._connections.make_room(waiting.rank):
            self._open(waiting)
        # Nobody waits longer for a place: a caller that gave up must not get one.
        elif time.monotonic() - waiting.since_s > WAIT_MAX_S:
            waiting.sock.close()
        else:
            self._hold(waiting)
            return
        # In the next turn: the protocol reads the request first, and the acceptor keeps its copy until then.
        self._loop.call_soon(self._acceptor.confirm, waiting.number)

    def _hold(self, waiting: Waiting) -> None:
        def retry() -> None:
            del self._held[handle]
            self._receive(waiting)

        handle = self._loop.call_later(RETRY_S, retry)
        self._held[handle] = waiting

    def _open(self, waiting: Waiting) -> None:
        self._selector.add_client(waiting.sock, waiting.since_s)
        # Counted at once: asyncio opens it a turn later, and the places would be given twice.
        self._connections.opening += 1
        task: asyncio.Task[object] = self._loop.create_task(
            self._loop.connect_accepted_socket(self._create_protocol, waiting.sock)
        )
        self._opening.add(task)
        task.add_done_callback(self._on_opened)

    def _on_opened(self, task: "asyncio.Task[object]") -> None:
        self._opening.discard(task)
        if task.cancelled() or task.exception() is not None:
            self._connections.opening -= 1


SHUTDOWN_GRACE_S = 2
REVOKED_MAX_S = 1.0


class Server(uvicorn.Server):
    """Captures no signals: uvicorn would raise them again and end the process before the board receives ABORT.

    acceptor: hands over the connections; policy: decides which requests for STOP precede others
    """

    on_ready: Callable[[], None] = staticmethod(lambda: None)
    loop: asyncio.AbstractEventLoop | None = None

    def __init__(self, app: App, acceptor: AcceptorClient, policy: AccessPolicy) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                http=BoundedHttp,
                ws=BoundedWebSocket,
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,  # a client must not set its own address
                timeout_graceful_shutdown=SHUTDOWN_GRACE_S,
                timeout_keep_alive=round(PHASE_MAX_S["idle"]),
                ws_max_size=MESSAGE_MAX_BYTES,
                ws_per_message_deflate=False,  # a small frame could need any amount of memory
            )
        )
        self._acceptor = acceptor
        self._selector = StopFirstSelector(lambda head: rank_request(parse_head(head), policy) is Rank.STOP)
        self._connections = Connections(time.monotonic)
        self.server_state: ServerState = ServerState(self._connections, self._selector)
        self._opener: ConnectionOpener | None = None

    def run(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve the connections that the acceptor hands over until `should_exit`."""
        raise_descriptor_limit()
        with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(self._selector)) as runner:
            runner.run(self.serve(sockets=sockets))

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture no signals."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to accept requests."""
        await super().startup(sockets=[])
        self.loop = asyncio.get_running_loop()
        self._opener = ConnectionOpener(self._acceptor, self._selector, self._connections, self._create_protocol)
        self._acceptor.start()
        self.on_ready()

    async def close_revoked(self, tokens: Collection[Token]) -> None:
        """Close the kept connections of some tokens, and cut those whose clients do not follow within a second."""
        self._connections.close_revoked(tokens, is_final=False)
        await asyncio.sleep(REVOKED_MAX_S)
        self._connections.close_revoked(tokens, is_final=True)

    def _create_protocol(self) -> asyncio.Protocol:
        return BoundedHttp(self.config, self.server_state, self.lifespan.state)

    async def on_tick(self, counter: int) -> bool:
        """Close connections that take too long. Return whether the server must end."""
        self._connections.close_expired()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End all connections."""
        if self._opener is not None:
            self._opener.close()
        await super().shutdown(sockets)
