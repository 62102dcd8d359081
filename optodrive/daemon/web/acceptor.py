"""Opening of connections: those that wait with a request get a protocol, a few at a time, STOP first."""

import asyncio
from collections.abc import Callable

from optodrive.daemon.web.connections import Connections
from optodrive.daemon.web.request_head import Rank
from optodrive.daemon.web.stop_first_selector import StopFirstSelector
from optodrive.daemon.web.waiting_room import WaitingRoom

OPENED_PER_TURN = {Rank.STOP: 3, Rank.TOKEN: 3, Rank.OTHER: 1}
RETRY_S = 0.02
"""Interval at which waiting connections are looked at while there is no room."""
PAUSE_S = 0.05
"""Pause after a failed accept: the process has no descriptor left."""


class Acceptor:
    """Takes connections from the waiting room and opens them."""

    def __init__(
        self,
        room: WaitingRoom,
        selector: StopFirstSelector,
        connections: Connections,
        create_protocol: Callable[[], asyncio.Protocol],
    ) -> None:
        self._room = room
        self._selector = selector
        self._connections = connections
        self._create_protocol = create_protocol
        self._loop = asyncio.get_running_loop()
        self._opening: set[asyncio.Task[object]] = set()
        self._scheduled: asyncio.Handle | None = None
        room.on_failure = self._pause

    def start(self) -> None:
        """Begin to accept."""
        self._loop.add_reader(self._room.fileno(), self._receive)

    def close(self) -> None:
        """Accept no more, and close what waits."""
        self._loop.remove_reader(self._room.fileno())
        if self._scheduled is not None:
            self._scheduled.cancel()
        self._room.close()

    def _receive(self) -> None:
        self._room.receive()
        self._open_waiting()

    def _pause(self) -> None:
        self._connections.close_longest_idle()
        self._loop.remove_reader(self._room.fileno())
        self._loop.call_later(PAUSE_S, self.start)

    def _open_waiting(self) -> None:
        """Open the connections of the highest rank that waits, as far as there is room."""
        if self._scheduled is not None:
            self._scheduled.cancel()
            self._scheduled = None
        rank = self._room.find_next()
        if rank is None:
            return
        delay_s = 0.0
        for _ in range(OPENED_PER_TURN[rank]):
            if self._room.find_next() != rank:
                break
            if not self._connections.make_room(rank):
                delay_s = RETRY_S
                break
            self._open()
        if self._room.find_next() is not None:
            self._scheduled = self._loop.call_later(delay_s, self._open_waiting)

    def _open(self) -> None:
        waiting = self._room.take()
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
