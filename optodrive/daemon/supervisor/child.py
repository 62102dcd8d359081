"""One child process: its start, its beats, its death, and the delay before it starts again."""

import json
import os
import signal
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from typing import Any

from optodrive.core.child_process import BEAT, FAILED, PACKET_MAX_BYTES, READY, describe_end
from optodrive.core.clock import Clock

HANG_S = 2.0
"""A child counts as hung after this time without a beat."""
START_TIMEOUT_S = 20.0
"""A child counts as hung if it is not ready after this time."""
RESTART_DELAYS_S = (0.0, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
STEADY_S = 60.0
"""A child that lived this long starts again at once."""
StartProcess = Callable[[socket.socket, int], int]


@dataclass(frozen=True)
class StartFailure:
    """Failure that a child reported instead of its readiness: one line and the exit status for the daemon."""

    message: str
    exit_status: int


class Child:
    """A child process, which starts again after its death.

    name: of the process; start: starts it with its end of the channel and the number of the start, and returns its id
    failure: why it could not serve, as it reported; is_ready: whether it serves
    """

    def __init__(self, name: str, start: StartProcess, clock: Clock) -> None:
        self.name = name
        self.pid = 0
        self.starts = 0
        self.is_ready = False
        self.failure: StartFailure | None = None
        self.killed_because = ""
        self._start_process = start
        self._clock = clock
        self._channel: socket.socket | None = None
        self._exit_descriptor = -1
        self._started_s = self._beaten_s = -inf
        self._start_at_s = -inf
        self._failed_starts = 0

    # --- life -------------------------------------------------------------------------------------------------------

    @property
    def is_running(self) -> bool:
        """Whether the process exists."""
        return self.pid != 0

    @property
    def is_due(self) -> bool:
        """Whether the process must start now."""
        return not self.is_running and self._clock.now_s() >= self._start_at_s

    def start(self) -> None:
        """Start the process."""
        own, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        own.setblocking(False)
        self.starts += 1
        self.is_ready, self.failure, self.killed_because = False, None, ""
        self._started_s = self._beaten_s = self._clock.now_s()
        with theirs:
            # The child's end is closed here right after: only then does its death show as an end of file.
            self.pid = self._start_process(theirs, self.starts)
        self._channel = own
        # A death wakes the loop by this descriptor, at once and not with the next missing beat.
        self._exit_descriptor = os.pidfd_open(self.pid)

    def send_signal(self, number: int) -> None:
        """Send a signal if the process runs."""
        if self.is_running:
            os.kill(self.pid, number)

    def kill(self, reason: str) -> None:
        """Kill the process. reason: for the line that reports its death."""
        self.killed_because = reason
        self.send_signal(signal.SIGKILL)

    def collect(self) -> str | None:
        """Return how the process has ended and schedule its next start. Return None while it runs."""
        if not self.is_running:
            return None
        pid, wait_status = os.waitpid(self.pid, os.WNOHANG)
        if pid == 0:
            return None
        self.receive()  # a failure that it reported before its end
        self._close()
        now_s = self._clock.now_s()
        if now_s - self._started_s >= STEADY_S:
            self._failed_starts = 0
        self._start_at_s = now_s + RESTART_DELAYS_S[min(self._failed_starts, len(RESTART_DELAYS_S) - 1)]
        self._failed_starts += 1
        self.pid, self.is_ready = 0, False
        return self.killed_because or describe_end(wait_status)

    def _close(self) -> None:
        if self._channel is not None:
            self._channel.close()
            self._channel = None
            os.close(self._exit_descriptor)

    # --- channel ----------------------------------------------------------------------------------------------------

    @property
    def descriptors(self) -> list[int]:
        """Descriptors that become readable at the death of the process and, until it is ready, for its messages."""
        if self._channel is None:
            return []
        # Beats of a child that serves are read at each tick: each would otherwise wake the loop ten times per second.
        return [self._exit_descriptor] if self.is_ready else [self._exit_descriptor, self._channel.fileno()]

    def receive(self) -> list[dict[str, Any]]:
        """Take beats and reports that have arrived, and return the other messages."""
        others = []
        for fields in self._read_packets():
            kind = fields.get("kind")
            self._beaten_s = self._clock.now_s()
            if kind == READY:
                self.is_ready = True
            elif kind == FAILED:
                self.failure = StartFailure(str(fields.get("message")), int(fields.get("exit_status", 1)))
            elif kind != BEAT:
                others.append(fields)
        return others

    def _read_packets(self) -> list[dict[str, Any]]:
        packets: list[dict[str, Any]] = []
        while self._channel is not None:
            try:
                packet = self._channel.recv(PACKET_MAX_BYTES)
            except OSError:
                break
            if not packet:
                break
            with suppress(ValueError):
                packets.append(json.loads(packet))
        return packets

    def send(self, fields: dict[str, Any]) -> bool:
        """Send a control message, and return whether the process can receive it."""
        if self._channel is None:
            return False
        try:
            self._channel.send(json.dumps(fields).encode())
        except OSError:
            return False
        return True

    def excuse(self) -> None:
        """Count from now on: the supervisor itself did not run, and the process may not have run either."""
        if not self.is_ready:
            self._started_s = self._clock.now_s()
        self._beaten_s = self._clock.now_s()

    def find_hang(self, now_s: float) -> str | None:
        """Return why the process counts as hung, None if it does not. Call it after receive().

        now_s: time before receive(). If the supervisor is suspended after it, the beats of the meantime are unread.
        """
        # Killed already: its death is on the way.
        if not self.is_running or self.killed_because:
            return None
        if not self.is_ready:
            waited_s = now_s - self._started_s
            return f"not ready after {START_TIMEOUT_S:g} s" if waited_s > START_TIMEOUT_S else None
        return f"no beat for {HANG_S:g} s" if now_s - self._beaten_s > HANG_S else None
