"""Connection to the link process of everyone whose loop polls: planner, acceptor, supervisor, an operator's command.

Results of requests carry an error as fields of a message, which becomes the error again at the caller. STOP of an
operator's command goes directly to the link process: it needs neither the web process nor the planner.
"""

import select
import time
from collections.abc import Callable, Mapping
from math import inf
from pathlib import Path
from typing import Any

from optodrive.core import errors
from optodrive.core.clock import Clock, MonotonicClock
from optodrive.core.errors import LinkError, OptodriveError
from optodrive.core.ipc import IpcClosed, IpcError, Message, MessageSocket


def build_result(request_id: int, error: OptodriveError | None, fields: dict[str, Any]) -> Message:
    """Return the result of a request.

    error: None if it was carried out; fields: further fields
    """
    error_fields = None
    if error is not None:
        error_fields = {"code": error.code, "message": str(error), "type": type(error).__name__}
    return Message("result", {"id": request_id, "error": error_fields, **fields})


def build_error(fields: dict[str, Any]) -> OptodriveError:
    """Return the error of a result, of its own type if that needs nothing but a message."""
    kind = getattr(errors, str(fields["type"]), OptodriveError)
    if not (isinstance(kind, type) and issubclass(kind, OptodriveError)) or kind.__init__ is not Exception.__init__:
        kind = OptodriveError
    error: OptodriveError = kind(fields["message"])
    error.code = fields["code"]
    return error


RETRY_S = 0.1
"""Interval of the attempts to connect."""
NO_REQUEST = 0
"""Identifier of a request whose result nobody awaits."""
ResultHandler = Callable[[dict[str, Any]], object]


def ignore_result(result: dict[str, Any]) -> None:
    """Do nothing with a result."""


class LinkConnection:
    """Connection to the link process, or to the next one that listens at the path. Only `request` waits.

    role: of this process; end_reason: why the last connection has ended, as an end of a sentence
    on_message: receives each message but the result that `request` awaits; on_lost: called after a connection's end
    """

    def __init__(self, path: Path, role: str, clock: Clock, retry_s: float = RETRY_S) -> None:
        self.on_message: Callable[[Message], None] = lambda message: None
        self.on_lost: Callable[[], None] = lambda: None
        self.end_reason = "the link process is not reached yet"
        self._path = path
        self._role = role
        self._clock = clock
        self._retry_s = retry_s
        self._connect_at_s = -inf
        self._socket: MessageSocket | None = None
        self._request_id = 0
        self._on_result: ResultHandler | None = None

    @property
    def is_open(self) -> bool:
        """Whether the connection is up."""
        return self._socket is not None

    def fileno(self) -> int:
        """Return the descriptor that is readable when messages have arrived, −1 without a connection."""
        return -1 if self._socket is None else self._socket.fileno()

    @property
    def wants_write(self) -> bool:
        """Whether bytes wait until the link process reads: `receive` sends them, too."""
        return self._socket is not None and self._socket.wants_write

    def open(self) -> None:
        """Connect. Raise OSError if nobody listens, or if it is full."""
        self.attach(MessageSocket.connect(self._path))
        self.send(Message("hello", {"role": self._role}))

    def attach(self, connected: MessageSocket) -> None:
        """Use a connected socket."""
        self._socket = connected

    def connect_if_due(self) -> bool:
        """Connect if there is no connection, at most once per interval. Return whether there is a new connection."""
        now_s = self._clock.now_s()
        if self.is_open or now_s < self._connect_at_s:
            return False
        self._connect_at_s = now_s + self._retry_s
        try:
            self.open()
        except OSError:
            return False
        return self.is_open

    def send(self, message: Message) -> bool:
        """Send a message. Return False without a connection. Raise IpcError if the message is too large."""
        if self._socket is None:
            return False
        try:
            self._socket.send(message)
        except IpcClosed as error:
            self.close(f"the link process has ended: {error}")
        return self.is_open

    def send_stop(self) -> None:
        """Send STOP without waiting for its result."""
        self.send(Message("stop", {"id": NO_REQUEST}))

    def receive(self) -> None:
        """Process the messages that have arrived, a bounded number, and send the bytes that wait."""
        if self._socket is None:
            return
        try:
            if self._socket.wants_write:
                self._socket.flush()
            for message in self._socket.receive():
                self._take(message)
        except IpcError as error:
            self.close(f"the link process has ended: {error}")

    def _take(self, message: Message) -> None:
        on_result = self._on_result
        if on_result is not None and message.kind == "result" and message.fields["id"] == self._request_id:
            self._on_result = None
            on_result(message.fields)
        else:
            self.on_message(message)

    def request(
        self,
        kind: str,
        fields: Mapping[str, Any],
        timeout_s: float,
        payload: bytes = b"",
        on_result: ResultHandler = ignore_result,
    ) -> dict[str, Any] | None:
        """Send a request, wait for its result and return it. Return None if the connection ends, or ends for its want.

        on_result: called with the result before any later message is processed
        """
        results: list[dict[str, Any]] = []

        def take(result: dict[str, Any]) -> None:
            results.append(result)
            on_result(result)

        self._request_id += 1
        self._on_result = take
        self.send(Message(kind, {"id": self._request_id, **fields}, payload))
        deadline_s = self._clock.now_s() + timeout_s
        while self._socket is not None and not results:
            wait_s = deadline_s - self._clock.now_s()
            writable = [self._socket] if self._socket.wants_write else []
            # Without time left, read once more: this process may have waited for the processor.
            select.select([self._socket], writable, [], max(0.0, wait_s))
            self.receive()
            if wait_s <= 0.0 and not results:
                # Closed, not retried: link then loses its planner and goes dark, and nobody acts on a result that comes
                # too late.
                self.close(f"the link process did not answer {kind} within {timeout_s:g} s")
        self._on_result = None
        return results[0] if results else None

    def close(self, reason: str = "this process has ended its connection to the link process") -> None:
        """End the connection. reason: as an end of a sentence."""
        if self._socket is not None:
            self._socket.close()
            self._socket, self.end_reason = None, reason
            self.on_lost()


STOP_TIMEOUT_S = 7.0
"""Longest wait for the result. The link process itself gives the board less."""
STOP_RETRY_S = 0.005


def stop_board(path: Path, timeout_s: float = STOP_TIMEOUT_S) -> dict[str, Any] | None:
    """Switch the gate off, drop everything queued and disarm. Return the result with the fields `board` and `epoch`.

    Return None if no link process listens at the path or this user may not open it: nothing was sent then. Raise the
    error of the link process, or LinkError if it does not answer.
    """
    clock = MonotonicClock()
    deadline_s = clock.now_s() + timeout_s
    connection = LinkConnection(path, "operator", clock)
    while True:
        try:
            connection.open()
            break
        # The listen queue is full for a moment; any other error means that nobody will answer.
        except BlockingIOError:  # others connect
            if clock.now_s() > deadline_s:
                return None
            time.sleep(STOP_RETRY_S)
        except OSError:
            return None
    result = connection.request("stop", {}, deadline_s - clock.now_s())
    connection.close()
    if result is None:
        reason = connection.end_reason
        raise LinkError(f"stop was not answered at {path} ({reason}): use the emergency stop or the key")
    if result["error"] is not None:
        raise build_error(result["error"])
    return result
