"""The HTTP protocol of the web server, with bounded reads and a known phase."""

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from optodrive.daemon.api.scope_keys import ARRIVED_S, CALLER
from optodrive.daemon.api.tokens import ANONYMOUS, Token
from optodrive.daemon.server.connections import PhaseOfRequest
from optodrive.daemon.server.server_state import ServerState

HEADER_READ_BYTES, BODY_READ_BYTES = 2048, 8192
"""The size of one read: a body of chunks of one byte takes 2 µs per byte to parse, and STOP waits meanwhile."""
DRAIN_MAX_BYTES = 65_536
"""Bytes of a chunked body that are read after its request has been answered."""


class BoundedHttp(H11Protocol):
    """uvicorn's protocol with bounded reads, whose connection is in the table of open connections."""

    server_state: ServerState
    _drained_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Add the connection."""
        super().connection_made(transport)
        self._set_read_size(HEADER_READ_BYTES)
        self.server_state.clients.add(transport, self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection."""
        self.server_state.forget(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse the received bytes, unless they are an endless body of a request that has been answered."""
        if self.get_phase().phase == "drain" and b"transfer-encoding" in dict(self.headers):
            self._drained_bytes += len(data)
            if self._drained_bytes > DRAIN_MAX_BYTES:
                self.transport.abort()
                return
        self.app_state = {**self.app_state, ARRIVED_S: self.server_state.pop_arrival_s(self.transport)}
        super().data_received(data)
        self._set_read_size(BODY_READ_BYTES if self.get_phase().phase in ("body", "drain") else HEADER_READ_BYTES)

    def on_response_complete(self) -> None:
        """Begin to be idle, or the next request."""
        super().on_response_complete()
        self.server_state.clients.update_phase(self.transport)

    def get_caller(self) -> Token:
        """Return the token of the last request, ANONYMOUS without one."""
        scope: Any = self.scope  # None before the first request
        caller: Token = ANONYMOUS if scope is None else scope.get(CALLER, ANONYMOUS)
        return caller

    def get_phase(self) -> PhaseOfRequest:
        """Return the present phase."""
        cycle: Any = self.cycle  # None before the first request
        if cycle is not None and not cycle.response_complete:
            if self.flow.write_paused:
                return PhaseOfRequest("stalled", cycle)
            return PhaseOfRequest("body" if cycle.more_body else "answer", cycle)
        if self.conn.their_state is h11.SEND_BODY:
            return PhaseOfRequest("drain", cycle)
        is_within_header = cycle is None or bool(self.conn.trailing_data[0])
        return PhaseOfRequest("headers" if is_within_header else "idle", cycle)

    def _set_read_size(self, size: int) -> None:
        transport: Any = self.transport
        transport.max_size = size  # of asyncio's selector transports
