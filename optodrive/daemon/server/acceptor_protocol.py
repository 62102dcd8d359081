"""Packets between acceptor and web process, on a Unix socket that preserves message boundaries.

acceptor → web: a beat, or a connection with its number, its rank and the time of its head
web → acceptor: the number of a connection that it has opened or closed, after which one more of its rank may come
"""

import socket
import struct

from optodrive.daemon.server.request_head import Rank
from optodrive.daemon.server.timed_socket import TimedSocket
from optodrive.daemon.server.waiting_room import Waiting

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
