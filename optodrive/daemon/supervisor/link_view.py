"""The supervisor's view of the link process: its last status, and STOP."""

from pathlib import Path
from typing import Any

from optodrive.core.clock import Clock
from optodrive.core.ipc import Message
from optodrive.link.service.link_connection import LinkConnection
from optodrive.link.session.board_connector import CONNECTING

CONNECT_INTERVAL_S = 0.02


class LinkView:
    """Client of the link process. status: fields of the last status, empty without a connection."""

    def __init__(self, path: Path, clock: Clock) -> None:
        self.status: dict[str, Any] = {}
        self._connection = LinkConnection(path, "supervisor", clock, CONNECT_INTERVAL_S)
        self._connection.on_message = self._on_message
        self._connection.on_lost = self._on_lost

    @property
    def descriptors(self) -> list[int]:
        """Descriptor that becomes readable for a status, if there is a connection."""
        return [self._connection.fileno()] if self._connection.is_open else []

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
        self._connection.connect_if_due()
        self._connection.receive()

    def _on_message(self, message: Message) -> None:
        if message.kind == "status":
            self.status = message.fields

    def _on_lost(self) -> None:
        self.status = {}

    def stop(self) -> None:
        """Send STOP."""
        self._connection.send_stop()

    def stop_and_wait(self, timeout_s: float) -> None:
        """Send STOP and wait until the board has confirmed it, or there is none, for a limited time."""
        self._connection.request("stop", {}, timeout_s)

    def close(self) -> None:
        """Close the connection and forget the status."""
        self._connection.close()
