"""The supervisor's view of the link process: its last status, and STOP."""

from math import inf
from pathlib import Path
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.ipc import IpcError, Message, MessageSocket
from optodrive.link.session.board_connector import CONNECTING

CONNECT_INTERVAL_S = 0.02


class LinkView:
    """Client of the link process, which connects again when it is due.

    status: fields of the last status, empty without a connection; is_stopped: whether the link has answered STOP
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        self.status: dict[str, Any] = {}
        self.is_stopped = False
        self._path = path
        self._clock = clock
        self._connection: MessageSocket | None = None
        self._connect_at_s = -inf

    @property
    def descriptors(self) -> list[int]:
        """Descriptor that becomes readable for a status, if there is a connection."""
        return [] if self._connection is None else [self._connection.fileno()]

    @property
    def board_state(self) -> str:
        """State of the board, `no link` without a link."""
        return str(self.status["board"]["state"]) if self.status.get("connected") else "no link"

    @property
    def link_error(self) -> str:
        """Why the board is not connected, '' while it is or nothing is known yet."""
        if self.status.get("connected") or self.status.get("link_error_code") == CONNECTING:
            return ""
        return str(self.status.get("link_error") or "")

    def receive(self) -> None:
        """Process the messages that have arrived, and connect if there is no connection."""
        try:
            if self._connection is None:
                self._connect()
            for message in [] if self._connection is None else self._connection.receive():
                if message.kind == "status":
                    self.status = message.fields
                elif message.kind == "result":
                    self.is_stopped = True
        except IpcError:
            self.close()

    def _connect(self) -> None:
        now_s = self._clock.now_s()
        if now_s < self._connect_at_s:
            return
        self._connect_at_s = now_s + CONNECT_INTERVAL_S
        try:
            self._connection = MessageSocket.connect(self._path)
        except OSError:
            return
        self._connection.send(Message("hello", {"role": "supervisor"}))

    def stop(self) -> None:
        """Send STOP. It is answered when the board has confirmed it, or at once if there is no board."""
        self.is_stopped = False
        try:
            if self._connection is not None:
                self._connection.send(Message("stop", {"id": 1}))
        except IpcError:
            self.close()

    def close(self) -> None:
        """Close the connection and forget the status."""
        if self._connection is not None:
            self._connection.close()
        self._connection, self.status = None, {}
