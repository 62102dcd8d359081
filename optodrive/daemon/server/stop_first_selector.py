"""The selector of the web server's loop: few clients per turn, those that request STOP first.

asyncio serves everything that is ready before it polls its sockets again. With hundreds of busy clients such a turn
takes a tenth of a second, for which a STOP that has just arrived would wait.
"""

import asyncio
import selectors
import socket
import time
from collections.abc import Callable, Iterable

import uvicorn.server

from optodrive.daemon.api.request_limits import STOP_PATH
from optodrive.daemon.server.connections import Connections, peek_head
from optodrive.daemon.server.listeners import TimedSocket

CLIENTS_PER_TURN = 6
STOP = STOP_PATH.encode()


class StopFirstSelector(selectors.EpollSelector):
    """A selector that defers clients beyond the first of a turn. Their sockets stay ready for the next turn.

    permits_stop: whether the head of a request for STOP has what STOP needs; another one takes no precedence
    """

    def __init__(self, permits_stop: Callable[[bytes], bool]) -> None:
        super().__init__()
        self._permits_stop = permits_stop
        self._clients: dict[int, socket.socket] = {}
        self._deferred: dict[int, None] = {}
        self._arrived_s: dict[int, float] = {}

    def add_client(self, sock: socket.socket, arrived_s: float | None = None) -> None:
        """Defer the input of a socket if too many clients are ready. arrived_s: when input arrived, if there is any."""
        self._clients[sock.fileno()] = sock
        if arrived_s is not None:
            self._arrived_s[sock.fileno()] = arrived_s

    def remove_client(self, fileno: int) -> None:
        """Forget a socket that is about to be closed."""
        self._clients.pop(fileno, None)
        self._arrived_s.pop(fileno, None)

    def pop_arrival_s(self, fileno: int) -> float:
        """Return the monotonic time at which the input of a client arrived that was just read."""
        sock = self._clients.get(fileno)
        received_s = sock.received_s if isinstance(sock, TimedSocket) else None
        waiting_s = self._arrived_s.pop(fileno, None)
        return min(at_s for at_s in (received_s, waiting_s, time.monotonic()) if at_s is not None)

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return the ready keys: everything but clients, STOP first, then the clients that have waited longest."""
        ready = super().select(timeout)
        # The usual case costs no look into any socket.
        if len(ready) <= CLIENTS_PER_TURN:
            return ready
        clients = {key.fd: (key, events) for key, events in ready if self._is_input(key.fd, events)}
        others = [(key, events) for key, events in ready if key.fd not in clients]
        chosen = self._choose(clients)
        # Timers, signals and connections to other processes are never deferred: they carry STOP's confirmation.
        return [clients[fd] for fd in chosen] + others

    def _is_input(self, fileno: int, events: int) -> bool:
        return fileno in self._clients and events == selectors.EVENT_READ

    def _is_stop(self, sock: socket.socket) -> bool:
        """Return whether a permitted request for STOP waits in a socket. It stays there."""
        head = peek_head(sock) or b""
        return head.startswith(b"POST ") and STOP in head.partition(b"\r")[0] and self._permits_stop(head)

    def _choose(self, filenos: Iterable[int]) -> list[int]:
        ready = dict.fromkeys(filenos)
        # Those deferred before come first, so each gets its turn.
        queue = dict.fromkeys([fd for fd in self._deferred if fd in ready]) | ready
        stops = dict.fromkeys(fd for fd in queue if self._is_stop(self._clients[fd]))
        chosen = list(stops | queue)[:CLIENTS_PER_TURN]
        self._deferred = {fd: None for fd in queue if fd not in chosen}
        now_s = time.monotonic()
        for fd in self._deferred:
            # A deferred client keeps the first time: its latency and epoch include the wait.
            self._arrived_s.setdefault(fd, now_s)
        return chosen


class ServerState(uvicorn.server.ServerState):
    """uvicorn's state with the table of open connections."""

    def __init__(self, clients: Connections, selector: StopFirstSelector) -> None:
        super().__init__()
        self.clients = clients
        self.selector = selector

    def pop_arrival_s(self, transport: asyncio.BaseTransport) -> float:
        """Return the monotonic time at which the input of a connection arrived that was just read."""
        return self.selector.pop_arrival_s(transport.get_extra_info("socket").fileno())

    def forget(self, transport: asyncio.Transport) -> None:
        """Remove a connection that is about to be closed."""
        self.clients.remove(transport)
        sock = transport.get_extra_info("socket")
        if sock is not None:
            self.selector.remove_client(sock.fileno())
