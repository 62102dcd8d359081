"""The open connections of the web server: their number, and how long each may stay in one phase."""

import asyncio
import socket
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, NamedTuple, Protocol
from urllib.parse import unquote

from optodrive.daemon.api.access_policy import AccessPolicy, RequestContext
from optodrive.daemon.api.request_limits import STOP_PATH, join_headers, normalise_path
from optodrive.daemon.api.tokens import ANONYMOUS, Token

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


CONNECTIONS_MAX = 256
STOP_RESERVE = 64
"""Connections beyond CONNECTIONS_MAX, only for those that begin with a request for STOP and a valid token."""
Phase = Literal["headers", "idle", "drain", "body", "stalled", "answer", "stream"]
PHASE_MAX_S: dict[Phase, float] = {"headers": 5.0, "idle": 15.0, "drain": 5.0, "body": 30.0, "stalled": 30.0}
"""The longest time of a phase: a request's header, between requests, the rest of a body that nobody reads, a body, a
client that does not read its answer. An answer and a stream have no limit."""
IDLE_PHASES: tuple[Phase, ...] = ("headers", "idle", "drain")
SLOW_BODY_S = 5.0
"""A connection in one of these phases may be closed in favour of a new one; within a body after this time."""


class PhaseOfRequest(NamedTuple):
    """The phase of a connection and the request to which it belongs."""

    phase: Phase
    request: object = None


class ClientProtocol(Protocol):
    """The protocol of a connection."""

    def get_phase(self) -> PhaseOfRequest:
        """Return the present phase."""

    def get_caller(self) -> Token:
        """Return the token of the last request, ANONYMOUS without one."""


@dataclass
class _Entry:
    client: ClientProtocol
    phase: PhaseOfRequest
    since_s: float


class Connections:
    """The open connections.

    now_s: monotonic clock; opening: number of those that are about to be added
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._entries: dict[asyncio.Transport, _Entry] = {}
        self.opening = 0

    def __len__(self) -> int:
        return len(self._entries) + self.opening

    def add(self, transport: asyncio.Transport, client: ClientProtocol) -> None:
        """Add a connection that has been opened, or replace its protocol."""
        # A WebSocket replaces the HTTP protocol of the same transport, and was counted then.
        if transport not in self._entries:
            self.opening -= 1
        self._entries[transport] = _Entry(client, client.get_phase(), self._now_s())

    def remove(self, transport: asyncio.Transport) -> None:
        """Remove a connection that is closed."""
        self._entries.pop(transport, None)

    def update_phase(self, transport: asyncio.Transport) -> None:
        """Begin a new phase of a connection now."""
        entry = self._entries.get(transport)
        if entry is not None:
            entry.phase, entry.since_s = entry.client.get_phase(), self._now_s()

    def make_room(self, rank: Rank) -> bool:
        """Return whether a new connection may be opened. Close those that have been idle longest if need be.

        One without a token takes no place from one with a token.
        """
        while len(self) >= CONNECTIONS_MAX and self.close_longest_idle(spares_trusted=rank is Rank.OTHER):
            pass
        # The reserve is for STOP alone: it must find a place when all others are taken by streams, which have no limit
        # of time.
        return len(self) < CONNECTIONS_MAX + (STOP_RESERVE if rank is Rank.STOP else 0)

    def close_longest_idle(self, spares_trusted: bool = False) -> bool:
        """Close the connection that has been idle longest, one with a valid token last. Return whether there is one."""
        now_s = self._update_phases()
        idle = [
            item
            for item in self._entries.items()
            if _is_replaceable(item[1], now_s) and not (spares_trusted and _is_trusted(item[1]))
        ]
        if not idle:
            return False
        self._abort(min(idle, key=lambda item: (_is_trusted(item[1]), item[1].since_s))[0])
        return True

    def close_expired(self) -> None:
        """Close the connections that exceed the time of their phase."""
        now_s = self._update_phases()
        for transport, entry in list(self._entries.items()):
            limit_s = PHASE_MAX_S.get(entry.phase.phase)
            if limit_s is not None and now_s - entry.since_s > limit_s:
                self._abort(transport)

    def close_revoked(self, tokens: Iterable[Token], is_final: bool) -> None:
        """Close the connections of some tokens that are between requests.

        Requests that are being answered end first; they may be STOP.
        is_final: close those in a stream, too
        """
        revoked = set(tokens)
        for transport, entry in list(self._entries.items()):
            phase = entry.client.get_phase().phase
            # An answer in progress may be that of STOP, which is never ended.
            if entry.client.get_caller() in revoked and phase != "answer" and (is_final or phase in IDLE_PHASES):
                self.remove(transport)
                transport.abort() if is_final else transport.close()

    def _update_phases(self) -> float:
        now_s = self._now_s()
        for entry in self._entries.values():
            phase = entry.client.get_phase()
            if phase != entry.phase:
                entry.phase, entry.since_s = phase, now_s
        return now_s

    def _abort(self, transport: asyncio.Transport) -> None:
        self.remove(transport)
        transport.abort()


def _is_trusted(entry: _Entry) -> bool:
    return entry.client.get_caller() is not ANONYMOUS


def _is_replaceable(entry: _Entry, now_s: float) -> bool:
    is_slow_body = entry.phase.phase == "body" and now_s - entry.since_s > SLOW_BODY_S
    return is_slow_body or entry.phase.phase in IDLE_PHASES
