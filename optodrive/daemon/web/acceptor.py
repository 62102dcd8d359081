"""Acceptance of connections: they are taken in small batches, those that begin with a request for STOP first."""

import asyncio
import socket
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from optodrive.daemon.web.connections import Connections
from optodrive.daemon.web.stop_first_selector import StopFirstSelector, has_input, is_stop

ACCEPTS_PER_TURN = 32
OPENED_PER_TURN = 3
WAITING_MAX = 512
WAIT_MAX_S = 1.0
"""Connections that wait to be opened, and for how long; the oldest beyond that is closed."""
RETRY_S = 0.02
"""Interval at which waiting connections are looked at while there is no room: has one requested STOP?"""
PAUSE_S = 0.05
"""Pause after a failed accept: the process has no descriptor left."""


class _Waiting(NamedTuple):
    sock: socket.socket
    arrived_s: float


class Acceptor:
    """Accepts connections of listening sockets and opens them a few at a time."""

    def __init__(
        self,
        listeners: Sequence[socket.socket],
        selector: StopFirstSelector,
        connections: Connections,
        create_protocol: Callable[[], asyncio.Protocol],
    ) -> None:
        self._listeners = listeners
        self._selector = selector
        self._connections = connections
        self._create_protocol = create_protocol
        self._loop = asyncio.get_running_loop()
        self._waiting: list[_Waiting] = []
        self._opening: set[asyncio.Task[object]] = set()
        self._scheduled: asyncio.Handle | None = None

    def start(self) -> None:
        """Begin to accept."""
        for listener in self._listeners:
            listener.setblocking(False)
            self._loop.add_reader(listener, self._accept, listener)

    def close(self) -> None:
        """Accept no more, and close what waits."""
        for listener in self._listeners:
            self._loop.remove_reader(listener)
        if self._scheduled is not None:
            self._scheduled.cancel()
        for waiting in self._waiting:
            waiting.sock.close()
        self._waiting.clear()

    def _accept(self, listener: socket.socket) -> None:
        for _ in range(ACCEPTS_PER_TURN):
            try:
                sock, _ = listener.accept()
            except (BlockingIOError, ConnectionAbortedError):
                break
            except OSError:
                self._pause(listener)
                break
            sock.setblocking(False)
            self._waiting.append(_Waiting(sock, self._loop.time()))
        self._schedule(0.0)

    def _pause(self, listener: socket.socket) -> None:
        self._connections.close_longest_idle()
        self._loop.remove_reader(listener)
        self._loop.call_later(PAUSE_S, partial(self._resume, listener))

    def _resume(self, listener: socket.socket) -> None:
        if listener.fileno() >= 0:
            self._loop.add_reader(listener, self._accept, listener)

    def _schedule(self, delay_s: float) -> None:
        if self._scheduled is not None:
            self._scheduled.cancel()
        self._scheduled = self._loop.call_later(delay_s, self._open_waiting) if self._waiting else None

    def _open_waiting(self) -> None:
        """Open connections as far as there is room; keep the others, which may yet request STOP, for a while."""
        stops: list[_Waiting] = []
        others: list[_Waiting] = []
        for waiting in self._waiting:
            (stops if is_stop(waiting.sock) else others).append(waiting)
        opened = [waiting for waiting in stops[:OPENED_PER_TURN] if self._open(waiting, True)]
        for waiting in others[:OPENED_PER_TURN]:
            if not self._open(waiting, False):
                break
            opened.append(waiting)
        oldest_s = self._loop.time() - WAIT_MAX_S
        kept = [waiting for waiting in stops if waiting not in opened]
        rest = [waiting for waiting in others if waiting not in opened]
        first = max(0, len(kept) + len(rest) - WAITING_MAX)
        for position, waiting in enumerate(rest):
            if position < first or waiting.arrived_s < oldest_s:
                waiting.sock.close()
            else:
                kept.append(waiting)
        self._waiting = kept
        self._schedule(0.0 if opened else RETRY_S)

    def _open(self, waiting: _Waiting, for_stop: bool) -> bool:
        if not self._connections.make_room(for_stop):
            return False
        sock = waiting.sock
        self._selector.add_client(sock, waiting.arrived_s if has_input(sock) else None)
        self._connections.opening += 1
        task: asyncio.Task[object] = self._loop.create_task(
            self._loop.connect_accepted_socket(self._create_protocol, sock)
        )
        self._opening.add(task)
        task.add_done_callback(self._on_opened)
        return True

    def _on_opened(self, task: "asyncio.Task[object]") -> None:
        self._opening.discard(task)
        if task.cancelled() or task.exception() is not None:
            self._connections.opening -= 1
