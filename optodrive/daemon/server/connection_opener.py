"""Opening of the connections that the acceptor hands over, as far as there is room."""

import asyncio
import time
from collections.abc import Callable

from optodrive.daemon.server.acceptor_client import AcceptorClient
from optodrive.daemon.server.connections import Connections
from optodrive.daemon.server.stop_first_selector import StopFirstSelector
from optodrive.daemon.server.waiting_room import WAIT_MAX_S, Waiting

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
        elif time.monotonic() - waiting.since_s > WAIT_MAX_S:
            waiting.sock.close()
        else:
            self._hold(waiting)
            return
        self._loop.call_soon(self._acceptor.confirm, waiting.number)

    def _hold(self, waiting: Waiting) -> None:
        def retry() -> None:
            del self._held[handle]
            self._receive(waiting)

        handle = self._loop.call_later(RETRY_S, retry)
        self._held[handle] = waiting

    def _open(self, waiting: Waiting) -> None:
        self._selector.add_client(waiting.sock, waiting.since_s)
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
