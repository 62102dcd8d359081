"""Connection of the engine's loop to the link process: connecting again, waiting for messages, beats."""

from contextlib import suppress
from pathlib import Path

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError
from optodrive.daemon.message_loop import MessageLoop
from optodrive.link.service.remote_session import RemoteSession

RECONNECT_INTERVAL_S = 0.1
BEAT_INTERVAL_S = 0.1
UNSENT_WAIT_S = 0.001
"""Longest wait while bytes wait for the link process."""


class SessionConnection:
    """Connection of a session within a message loop."""

    def __init__(self, session: RemoteSession, link_socket: Path, loop: MessageLoop, clock: Clock) -> None:
        self._session = session
        self._link_socket = link_socket
        self._loop = loop
        self._clock = clock
        self._watched: int | None = None
        self._retry_at_s = self._beaten_s = -float("inf")

    def exchange(self, wait_s: float) -> None:
        """Wait at most wait_s for messages of any connection of the loop, and process those of the link process."""
        self._follow_descriptor()
        now_s = self._clock.now_s()
        if not self._session.is_attached and now_s >= self._retry_at_s:
            self._retry_at_s = now_s + RECONNECT_INTERVAL_S
            with suppress(LinkError):
                self._session.connect(self._link_socket)
                self._beaten_s = -float("inf")  # the board cannot be armed before the first beat
            self._follow_descriptor()
        self._loop.poll(min(wait_s, UNSENT_WAIT_S) if self._session.wants_write else wait_s)
        self._session.receive()

    def _follow_descriptor(self) -> None:
        """Watch the session's descriptor, which another connection may get once the session has closed it."""
        descriptor = self._session.fileno() if self._session.is_attached else None
        if self._watched != descriptor:
            if self._watched is not None:
                self._loop.unwatch(self._watched)
            if descriptor is not None:
                self._loop.watch(descriptor, self._receive)
            self._watched = descriptor

    def _receive(self) -> None:
        self._session.receive()
        self._follow_descriptor()

    def beat(self, alive: bool) -> None:
        """Prove that the loop runs. alive: whether the planner is idle or makes progress."""
        now_s = self._clock.now_s()
        if now_s - self._beaten_s >= BEAT_INTERVAL_S:
            self._beaten_s = now_s
            self._session.beat(alive)

    def close(self) -> None:
        """End the connection, and the watch on it."""
        self._session.close()
        self._follow_descriptor()
