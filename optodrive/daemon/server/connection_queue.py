"""Connections that have been accepted but not opened: each waits for the head of its first request, then by its rank.

A connection costs a few system calls here, and a protocol with its buffers only once somebody asks something on it. So
connections without a request, and those that are closed at once, delay nobody.
"""

import select
import socket
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple

from optodrive.daemon.server.connections import PHASE_MAX_S, Rank, is_complete, peek_head

ACCEPTS_MAX, EVENTS_MAX = 64, 64
"""Connections that are accepted, and sockets that are looked at, before others get a turn."""
WAITING_MAX = 512
"""Connections that wait. Beyond that, the oldest of the most numerous kind gives way, one with a valid token last."""
WAIT_MAX_S = 5.0
"""The longest time that a request waits to be served. Its head must have arrived within the time of that phase."""
# Edge-triggered: a head that stays incomplete must not wake the loop again and again.
INPUT = select.EPOLLIN | select.EPOLLRDHUP | select.EPOLLET
END = select.EPOLLRDHUP | select.EPOLLHUP | select.EPOLLERR


class Waiting(NamedTuple):
    """A connection.

    since_s: monotonic time since which it waits for its head, or has had one; rank: by its head
    number: of the connection among those that a web process has got
    """

    sock: socket.socket
    since_s: float
    rank: Rank = Rank.OTHER
    number: int = 0


class ConnectionQueue:
    """The accepted connections of listening sockets.

    rank_head: ranks the head of a request; now_s: monotonic clock
    on_unserved: called before a connection with a request is closed that nobody has taken
    """

    def __init__(
        self, listeners: Sequence[socket.socket], rank_head: Callable[[bytes], Rank], now_s: Callable[[], float]
    ) -> None:
        self.on_unserved: Callable[[Waiting], None] = lambda waiting: None
        self._rank_head = rank_head
        self._now_s = now_s
        self._epoll = select.epoll()
        self._listeners = {listener.fileno(): listener for listener in listeners}
        self._silent: OrderedDict[int, Waiting] = OrderedDict()
        self._ranked: dict[Rank, OrderedDict[int, Waiting]] = {rank: OrderedDict() for rank in Rank}
        for fileno, listener in self._listeners.items():
            listener.setblocking(False)
            self._epoll.register(fileno, select.EPOLLIN)

    def __len__(self) -> int:
        return len(self._silent) + sum(map(len, self._ranked.values()))

    def fileno(self) -> int:
        """Return the descriptor that is readable when `receive` has something to do."""
        return self._epoll.fileno()

    def close(self) -> None:
        """Accept no more connections, and close those that wait."""
        self._epoll.close()
        for waiting in (self._silent, *self._ranked.values()):
            for entry in waiting.values():
                entry.sock.close()
            waiting.clear()

    # --- in ---------------------------------------------------------------------------------------------------------

    def receive(self) -> bool:
        """Accept connections, look at those whose head arrives, and return whether there may be more."""
        events_of = self._epoll.poll(0, EVENTS_MAX)
        is_busy = len(events_of) == EVENTS_MAX
        for fileno, events in events_of:
            if fileno in self._listeners:
                is_busy |= self._accept(self._listeners[fileno])
            else:
                self._look_again(fileno, bool(events & END))
        return is_busy

    def _accept(self, listener: socket.socket) -> bool:
        for _ in range(ACCEPTS_MAX):
            try:
                sock, _ = listener.accept()
            except (BlockingIOError, ConnectionAbortedError):
                return False
            except OSError:  # no descriptor is left
                # The listening socket stays readable: one that waits is closed, so that the next accept has a
                # descriptor.
                self._make_room()
                return True
            sock.setblocking(False)
            self._add(sock)
            while len(self) > WAITING_MAX:
                self._make_room()
        return True

    def _add(self, sock: socket.socket) -> None:
        now_s = self._now_s()
        head = peek_head(sock)
        if head == b"":
            sock.close()
        elif head is not None and is_complete(head):
            self._rank(Waiting(sock, now_s), head)
        else:
            self._silent[sock.fileno()] = Waiting(sock, now_s)
            self._epoll.register(
                sock.fileno(), INPUT
            )  # edge-triggered: one event per arrival, and one for what is there

    def _look_again(self, fileno: int, has_ended: bool) -> None:
        waiting = self._silent.get(fileno)
        if waiting is None:  # closed since
            return
        head = peek_head(waiting.sock)
        if head and is_complete(head):
            self._forget_silent(fileno)
            self._rank(waiting._replace(since_s=self._now_s()), head)
        # Its end counts only without a complete head: a caller may send STOP and close at once.
        elif head == b"" or has_ended:
            self._forget_silent(fileno).sock.close()

    def _rank(self, waiting: Waiting, head: bytes) -> None:
        rank = self._rank_head(head)
        self._ranked[rank][waiting.sock.fileno()] = waiting._replace(rank=rank)

    def _forget_silent(self, fileno: int) -> Waiting:
        with suppress(OSError):
            self._epoll.unregister(fileno)
        return self._silent.pop(fileno)

    # --- out --------------------------------------------------------------------------------------------------------

    def count(self, rank: Rank) -> int:
        """Return the number of connections that wait with a request of a rank."""
        return len(self._ranked[rank])

    def take(self, rank: Rank) -> Waiting:
        """Return the first connection of a rank, which the caller owns from now on. KeyError if there is none."""
        return self._ranked[rank].popitem(last=False)[1]

    def put_back(self, waiting: Waiting) -> None:
        """Let a connection that was taken be the first of its rank again, unless its request has been read since."""
        head = peek_head(waiting.sock)
        # Web has read it: what is left is no request, and to answer it would be the second answer.
        if not head or not is_complete(head):
            waiting.sock.close()
            return
        self._ranked[waiting.rank][waiting.sock.fileno()] = waiting
        self._ranked[waiting.rank].move_to_end(waiting.sock.fileno(), last=False)

    def close_expired(self) -> None:
        """Close the connections that have waited too long."""
        now_s = self._now_s()
        while self._silent and now_s - next(iter(self._silent.values())).since_s > PHASE_MAX_S["headers"]:
            self._forget_silent(next(iter(self._silent))).sock.close()
        for rank, waiting in self._ranked.items():
            while waiting and now_s - next(iter(waiting.values())).since_s > WAIT_MAX_S:
                self._close_first(rank)

    def _make_room(self) -> None:
        # The most numerous kind gives way: a flood of silent connections pushes out itself.
        if self._silent and len(self._silent) >= self.count(Rank.OTHER):
            self._forget_silent(next(iter(self._silent))).sock.close()
            return
        rank = next((rank for rank in reversed(Rank) if self.count(rank)), None)
        if rank is not None:
            self._close_first(rank)

    def _close_first(self, rank: Rank) -> None:
        waiting = self.take(rank)
        # Before it is closed: the head is still in the socket, and a STOP is audited from it.
        self.on_unserved(waiting)
        waiting.sock.close()
