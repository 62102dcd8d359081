"""The web process's connection to the acceptor, from which it gets the connections of its callers.

The Unix socket between them preserves message boundaries:
acceptor → web: a beat, or a connection with its number, its rank and the time of its head
web → acceptor: the number of a connection that it has opened or closed, after which one more of its rank may come
"""

import asyncio
import socket
import struct
import time
from collections.abc import Callable
from pathlib import Path

from optodrive.daemon.server.connection_queue import Waiting
from optodrive.daemon.server.connections import Rank
from optodrive.daemon.server.listeners import TimedSocket

BEAT = b"beat"
_CONNECTION_RECORD = struct.Struct("<QBd")
NUMBER = struct.Struct("<Q")


def send_connection(link: socket.socket, waiting: Waiting) -> None:
    """Send a connection, of which the caller keeps its own descriptor. Raise OSError if it cannot be sent now."""
    packet = _CONNECTION_RECORD.pack(waiting.number, waiting.rank, waiting.since_s)
    socket.send_fds(link, [packet], [waiting.sock.fileno()])


def receive_packet(link: socket.socket) -> Waiting | bytes:
    """Receive a connection, or the bytes of another packet, b'' at the end. Raise BlockingIOError if there is none."""
    data, descriptors, _, _ = socket.recv_fds(link, 64, 1)
    if not descriptors:
        return data
    sock = TimedSocket(fileno=descriptors[0])
    sock.setblocking(False)
    number, rank, since_s = _CONNECTION_RECORD.unpack(data)
    return Waiting(sock, since_s, Rank(rank), number)


RETRY_S = 0.05
BEAT_AGE_MAX_S = 1.0
"""Age of the acceptor's last beat beyond which it counts as stalled."""
STALL_S = 0.5
"""A loop that was away for longer was stalled itself, and judges nobody by the time that has passed."""
PACKETS_MAX = 16
"""Packets taken per turn of the loop."""


class AcceptorClient:
    """Connection to the acceptor, which connects again after its end. The event loop's thread calls everything.

    on_connection: receives each connection, and owns it; it calls `confirm` when the next may come
    on_connected: called before the first connection may come; on_lost: after the end of the acceptor's process
    """

    def __init__(self, path: Path) -> None:
        self.on_connection: Callable[[Waiting], None] = lambda waiting: waiting.sock.close()
        self.on_connected: Callable[[], None] = lambda: None
        self.on_lost: Callable[[], None] = lambda: None
        self._path = path
        self._socket: socket.socket | None = None
        self._retry: asyncio.TimerHandle | None = None
        self._beaten_s = self._checked_s = -float("inf")

    @property
    def is_connected(self) -> bool:
        """Whether the connection is up."""
        return self._socket is not None

    def check_beats(self) -> bool:
        """Return whether the acceptor's loop runs, so that a new caller could stop. Call it at every beat."""
        now_s = time.monotonic()
        # This process was suspended: beats wait unread, and the acceptor is not to blame.
        if now_s - self._checked_s > STALL_S:
            self._beaten_s = now_s
        self._checked_s = now_s
        return self._socket is not None and now_s - self._beaten_s <= BEAT_AGE_MAX_S

    def start(self) -> None:
        """Connect, and keep connecting until `close`."""
        self._retry = None
        loop = asyncio.get_running_loop()
        link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        link.setblocking(False)
        try:
            link.connect(str(self._path))
        except OSError:
            link.close()
            self._retry = loop.call_later(RETRY_S, self.start)
            return
        # Connected counts as a beat, or the first check would find none.
        self._socket, self._beaten_s = link, time.monotonic()
        loop.add_reader(link, self._receive, link)
        self.on_connected()

    def confirm(self, number: int) -> None:
        """Report that a connection has been opened or closed."""
        if self._socket is not None:
            try:
                self._socket.send(NUMBER.pack(number))
            except OSError:
                self._lose()

    def close(self) -> None:
        """End the connection permanently."""
        if self._retry is not None:
            self._retry.cancel()
        self._forget()

    def _receive(self, link: socket.socket) -> None:
        # Bounded: the loop serves STOP between two turns.
        for _ in range(PACKETS_MAX):
            try:
                packet = receive_packet(link)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self._lose()
                return
            self._beaten_s = time.monotonic()
            if isinstance(packet, Waiting):
                self.on_connection(packet)

    def _lose(self) -> None:
        if self._socket is None:
            return
        self._forget()
        # Before the retry: without an acceptor no new caller can stop, so the light ends now.
        self.on_lost()
        self._retry = asyncio.get_running_loop().call_later(RETRY_S, self.start)

    def _forget(self) -> None:
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
            self._socket = None
