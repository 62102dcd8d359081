"""The head of a connection's first request, read without taking it from the socket, and the rank that it gives."""

import socket
from enum import IntEnum
from urllib.parse import unquote

from optodrive.daemon.api.access_policy import AccessPolicy, RequestContext
from optodrive.daemon.api.request_limits import STOP_PATH, join_headers, normalise_path

HEAD_MAX_BYTES = 4096
"""A longer head counts as complete: what precedes its end decides."""


class Rank(IntEnum):
    """The order in which connections are served: a permitted STOP, others with a valid token, everybody else."""

    STOP = 0
    TOKEN = 1
    OTHER = 2


def peek_head(sock: socket.socket) -> bytes | None:
    """Return the bytes that wait in a socket, as far as a head may be long.

    Return b'' at its end, and None if there are none.
    """
    try:
        # Peeked, not read: the connection goes to the web process with its request still in the socket.
        return sock.recv(HEAD_MAX_BYTES, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return None
    except OSError:
        return b""


def is_complete(head: bytes) -> bool:
    """Return whether a request can be served: its head has ended, is too long, or is none."""
    return b"\r\n\r\n" in head or b"\n\n" in head or len(head) >= HEAD_MAX_BYTES or not head[:1].isalpha()


def parse_head(head: bytes, address: str = "") -> RequestContext | None:
    """Return the request that a head states, or None if it states none."""
    # Ten lines and not h11, which takes several times as long per head: 64 of them are one turn in real time.
    first, *lines = head.partition(b"\r\n\r\n")[0].decode("latin-1").split("\r\n")
    words = first.split(" ")
    if len(words) != 3:
        return None
    parts = (line.partition(":") for line in lines)
    headers = join_headers((name, value.strip(" \t")) for name, colon, value in parts if colon)
    return RequestContext(words[0], normalise_path(unquote(words[1].partition("?")[0])), headers, address)


def rank_request(request: RequestContext | None, policy: AccessPolicy) -> Rank:
    """Return the rank that a request gives its connection. request: None if there is none."""
    if request is None or policy.find_token(request) is None:
        return Rank.OTHER
    is_stop = request.method == "POST" and request.path == STOP_PATH and policy.permits_stop(request)
    return Rank.STOP if is_stop else Rank.TOKEN
