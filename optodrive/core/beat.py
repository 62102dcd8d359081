"""A child process's end of its channel to the supervisor: beats and reports go up, control messages come down.

The channel is a socket pair that preserves message boundaries; each packet is one JSON object with a `kind`. Its end of
file tells a child that the supervisor is dead.
"""

import json
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from optodrive.core.errors import OptodriveError

BEAT_INTERVAL_S = 0.1
PACKET_MAX_BYTES = 256_000
BEAT, READY, FAILED = "beat", "ready", "failed"
OUT_OF_MEMORY = "out of memory"
"""Reported by a process that could not allocate memory, which ends it."""


class SupervisorGoneError(OptodriveError):
    """The supervisor has ended, so its children end too."""

    code = "supervisor_gone"


class BeatWriter:
    """The child's end. Its methods never block.

    descriptor: inherited descriptor of the socket, owned from now on; now_s: monotonic clock
    """

    def __init__(self, descriptor: int, now_s: Callable[[], float] = time.monotonic) -> None:
        self._socket = socket.socket(fileno=descriptor)
        self._socket.setblocking(False)
        self._now_s = now_s
        self._beaten_s = -float("inf")

    def fileno(self) -> int:
        """Return the descriptor that becomes readable for a control message, or when the supervisor is dead."""
        return self._socket.fileno()

    def beat(self) -> None:
        """Prove that the caller's loop runs. Call it in every iteration. At most one packet per interval is sent."""
        now_s = self._now_s()
        if now_s - self._beaten_s >= BEAT_INTERVAL_S:
            self._beaten_s = now_s
            self.send({"kind": BEAT})

    def report_ready(self) -> None:
        """Report that the process serves its callers."""
        self.send({"kind": READY})

    def report_failure(self, message: str, exit_status: int = 1) -> None:
        """Report in one line why the process cannot serve. It ends afterwards."""
        self.send({"kind": FAILED, "message": message, "exit_status": exit_status})

    def send(self, fields: dict[str, Any]) -> None:
        """Send a message, or drop it while the supervisor does not read."""
        with suppress(OSError):
            self._socket.send(json.dumps(fields).encode())

    def receive(self) -> list[dict[str, Any]]:
        """Return the control messages that have arrived. Raise SupervisorGoneError at the end of file."""
        messages: list[dict[str, Any]] = []
        while True:
            try:
                packet = self._socket.recv(PACKET_MAX_BYTES)
            except BlockingIOError:
                return messages
            except OSError:
                packet = b""
            if not packet:
                raise SupervisorGoneError("the supervisor has ended")
            messages.append(json.loads(packet))

    def close(self) -> None:
        """Close the channel."""
        self._socket.close()
