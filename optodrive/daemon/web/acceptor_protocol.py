"""Packets between acceptor and web process, on a Unix socket that preserves message boundaries.

acceptor → web: a beat, or a connection with its rank and the time of its head
web → acceptor: permissions for connections of a rank, one each
"""

import socket
import struct

from optodrive.daemon.web.request_head import Rank
from optodrive.daemon.web.waiting_room import Waiting

BEAT = b"beat"
_CONNECTION = struct.Struct("<Bd")


def send_connection(link: socket.socket, waiting: Waiting) -> None:
    """Send a connection; the caller closes its own descriptor afterwards. Raise OSError if it cannot be sent now."""
    socket.send_fds(link, [_CONNECTION.pack(waiting.rank, waiting.since_s)], [waiting.sock.fileno()])


def receive_packet(link: socket.socket) -> Waiting | bytes:
    """Receive a connection, or the bytes of another packet; b'' at the end. Raise BlockingIOError if there is none."""
    data, descriptors, _, _ = socket.recv_fds(link, 64, 1)
    if not descriptors:
        return data
    sock = socket.socket(fileno=descriptors[0])
    sock.setblocking(False)
    rank, since_s = _CONNECTION.unpack(data)
    return Waiting(sock, since_s, Rank(rank))


def encode_permissions(ranks: list[Rank]) -> bytes:
    """Encode permissions."""
    return bytes(ranks)


def decode_permissions(data: bytes) -> list[Rank]:
    """Decode permissions."""
    return [Rank(value) for value in data]
