"""The HTTP and WebSocket protocols of the web server: bounded reads, messages, fragments and control frames.

What a client sends is parsed in small slices. Control frames and fragments, which carry no message by themselves, are
paced; what exceeds the pace waits in the client's socket. A message states when its first byte arrived, and the
earliest time at which that may have been, because a frame from before a STOP must not be shown after it: of bytes that
wait together in the socket, the kernel knows only when the newest arrived.
"""

import asyncio
from collections import deque
from typing import Any, NamedTuple, cast

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

from optodrive.daemon.api.request_limits import ARRIVED_S, CALLER, EARLIEST_S
from optodrive.daemon.api.tokens import ANONYMOUS, Token
from optodrive.daemon.server.connections import PhaseOfRequest
from optodrive.daemon.server.stop_first_selector import ServerState

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
        # A body with a length ends by itself; a chunked one need not.
        if self.get_phase().phase == "drain" and b"transfer-encoding" in dict(self.headers):
            self._drained_bytes += len(data)
            if self._drained_bytes > DRAIN_MAX_BYTES:
                self.transport.abort()
                return
        # A new dict: a request that is being answered keeps the time of its own head.
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


MESSAGE_MAX_BYTES = 262_144
FRAGMENTS_MAX = 64
"""Fragments of one message."""
SLICE_BYTES = 1024
SLICES_PER_TURN = 16
READ_BYTES = 16_384
FRAMES_PER_S, FRAMES_BURST = 50.0, 100.0
"""Pace of control frames and fragments."""
INVALID_DATA, TOO_BIG = 1007, 1009
EMPTY_S = 0.05
"""A socket that has had no input for this time while it was read is empty: what comes later arrives then."""


class _Arrival(NamedTuple):
    arrived_s: float
    earliest_s: float


class Utf8WebSocket(WebSocketsSansIOProtocol):
    """uvicorn's protocol, which closes the connection at text that is not UTF-8. It logs neither that nor a refusal."""

    def send_receive_event_to_app(self) -> None:
        """Queue a message that is complete."""
        try:
            if self.curr_msg_data_type == "text" and not self.close_sent:
                b"".join(self.frames).decode()
        except UnicodeDecodeError:
            self.conn.fail(INVALID_DATA, "text that is not UTF-8")
            self.handle_parser_exception()
            return
        super().send_receive_event_to_app()

    async def send(self, message: Any) -> None:
        """Send a message of the application. A refusal completes the handshake, which else counts as an error."""
        await super().send(message)
        self.handshake_complete = self.handshake_complete or self.close_sent


class BoundedWebSocket(Utf8WebSocket):
    """uvicorn's protocol with bounded and paced input."""

    _pump_handle: asyncio.Handle | None = None

    def __init__(self, server_state: ServerState, **options: Any) -> None:
        super().__init__(server_state=server_state, **options)
        self._state = server_state
        self._unparsed = bytearray()
        self._read = _Arrival(self.loop.time(), self.loop.time())
        self._begun: _Arrival | None = None  # of the message that is not complete yet
        self._arrivals: deque[_Arrival] = deque()  # of the messages in the queue
        self._unread_since_s: float | None = None
        self._empty_handle: asyncio.TimerHandle | None = None
        self._allowance = FRAMES_BURST
        self._allowance_s = self.loop.time()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Replace the HTTP protocol in the table of open connections."""
        super().connection_made(transport)
        cast(Any, transport).max_size = READ_BYTES
        self._state.clients.add(self.transport, self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection."""
        self._state.forget(self.transport)
        for handle in (self._pump_handle, self._empty_handle):
            if handle is not None:
                handle.cancel()
        super().connection_lost(exc)

    def get_caller(self) -> Token:
        """Return the token that opened the WebSocket, ANONYMOUS before that."""
        scope: Any = getattr(self, "scope", {})
        caller: Token = scope.get(CALLER, ANONYMOUS)
        return caller

    def get_phase(self) -> PhaseOfRequest:
        """Return the present phase."""
        return PhaseOfRequest("stream" if self.writable.is_set() else "stalled")

    def resume_writing(self) -> None:
        """Continue to parse once the client reads again."""
        super().resume_writing()
        self._pump()

    def data_received(self, data: bytes) -> None:
        """Parse the handshake at once, and frames at their pace. Read no more until they are parsed."""
        if not self.handshake_initiated:
            super().data_received(data)
            return
        arrived_s = self._state.pop_arrival_s(self.transport)
        # Input that filled the buffer, or arrived while nothing was read, may be as old as the last empty socket.
        earliest_s = arrived_s if self._unread_since_s is None else min(arrived_s, self._unread_since_s)
        self._unread_since_s = earliest_s if len(data) >= READ_BYTES else self.loop.time()
        self._read = _Arrival(arrived_s, earliest_s)
        # A message arrives with its first byte, in whichever read that was.
        self._begun = self._begun or self._read
        if self._empty_handle is not None:
            self._empty_handle.cancel()
        self._unparsed += data
        # Nothing more is read until this is parsed: what comes meanwhile waits in the kernel, where it costs no memory
        # here.
        self.transport.pause_reading()
        self._pump()

    def _resume_reading(self) -> None:
        self.transport.resume_reading()
        if self._empty_handle is not None:
            self._empty_handle.cancel()
        self._empty_handle = self.loop.call_later(EMPTY_S, self._on_empty)

    def _on_empty(self) -> None:
        self._unread_since_s = self._empty_handle = None

    async def receive(self) -> Any:
        """Return the next message, and continue to parse once the application has taken all."""
        message: Any = await self.queue.get()
        if message["type"] == "websocket.receive":
            message[ARRIVED_S], message[EARLIEST_S] = self._arrivals.popleft()
        if self.read_paused and self.queue.empty():
            self.read_paused = False
            self._pump()
        return message

    def _pump(self) -> None:
        """Parse the received bytes until a message is complete, the pace is exceeded or the turn is over."""
        if self._pump_handle is not None:
            self._pump_handle.cancel()
            self._pump_handle = None
        for _ in range(SLICES_PER_TURN):
            # A client that reads no answers gets no more of its input parsed.
            if self.read_paused or not self.writable.is_set() or self.transport.is_closing():
                return
            if not self._unparsed:
                self._resume_reading()
                return
            wait_s = self._compute_wait_s()
            if wait_s > 0.0:
                self._pump_handle = self.loop.call_later(wait_s, self._pump)
                return
            piece = bytes(self._unparsed[:SLICE_BYTES])
            del self._unparsed[:SLICE_BYTES]
            super().data_received(piece)
        # In the next turn of the loop: a large message is parsed between others, STOP among them.
        self._pump_handle = self.loop.call_soon(self._pump)

    def _compute_wait_s(self) -> float:
        now_s = self.loop.time()
        self._allowance = min(FRAMES_BURST, self._allowance + (now_s - self._allowance_s) * FRAMES_PER_S)
        self._allowance_s = now_s
        return max(0.0, -self._allowance / FRAMES_PER_S)

    def handle_ping(self) -> None:
        """Answer a ping, at its pace."""
        # Pings cost work and carry no message: unpaced, one client could keep the loop busy.
        self._allowance -= 1.0
        self._end_control_frame()
        super().handle_ping()

    def handle_pong(self, event: Frame) -> None:
        """Take a pong, at its pace."""
        self._allowance -= 1.0
        self._end_control_frame()
        super().handle_pong(event)

    def send_receive_event_to_app(self) -> None:
        """Queue a message that is complete, with its arrival."""
        self._arrivals.append(self._begun or self._read)
        self._begin_next()
        super().send_receive_event_to_app()

    def _end_control_frame(self) -> None:
        if not self.frames:  # it is not within a message
            self._begin_next()

    def _begin_next(self) -> None:
        """Let the next message begin with the received bytes, if any are left."""
        self._begun = self._read if self._unparsed or self.conn.reader.buffer else None

    def handle_cont(self, event: Frame) -> None:
        """Add a fragment. Close the connection if its message has too many."""
        self._allowance -= 1.0
        if self.close_sent:
            return
        if len(self.frames) >= FRAGMENTS_MAX:
            self.conn.fail(TOO_BIG, f"more than {FRAGMENTS_MAX} fragments")
            self.handle_parser_exception()
            return
        super().handle_cont(event)
