"""Connection of a session with its board: it opens the port and performs the handshake, again after each failure."""

from collections.abc import Callable, Iterator
from math import inf

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, OptodriveError
from optodrive.link.session.session import BoardSession

RETRY_INTERVAL_S = 1.0
OPENING_WAIT_S = 0.02
"""Longest wait for a port that is being opened."""
CONNECTING = "connecting"
"""Code of the error until the first connection has succeeded or failed."""


class BoardConnector:
    """Connects one session, step by step.

    error: why the board is not reached, None once it is
    open_port: opens the port; returns False while it needs more time, raises LinkError or InputError on failure
    """

    def __init__(self, session: BoardSession, clock: Clock, open_port: Callable[[], bool]) -> None:
        self.error: OptodriveError | None = LinkError("the board is not reached yet")
        self.error.code = CONNECTING
        self._session = session
        self._clock = clock
        self._open_port = open_port
        self._silence: OptodriveError | None = None
        self._steps: Iterator[float] | None = None
        self._wait_s = 0.0
        self._retry_at_s = -inf

    def step(self) -> None:
        """Keep the connection, or go on with the next step to it. A failure becomes `error`."""
        try:
            if self._session.connected:
                # Connected while another board is not: its link is kept, and its light is not.
                self._session.step(0.0, renew_lease=False)
            elif self._steps is not None or self._clock.now_s() >= self._retry_at_s:
                self._steps = self._steps or self._connect()
                self._wait_s = next(self._steps)
                if self._session.is_silent and self.error is not self._silence:
                    self.error = self._silence = self._session.build_silence_error()
        except StopIteration:
            self._steps = self.error = None
        except (LinkError, InputError) as error:
            self.lose(error)

    def _connect(self) -> Iterator[float]:
        try:
            while not self._open_port():
                yield OPENING_WAIT_S
        except (LinkError, InputError):
            self._session.on_connect_failed()
            raise
        yield from self._session.connect_step_by_step()

    def lose(self, error: OptodriveError) -> None:
        """Record why the board is not reached, with the likely cause if it was, and try again later."""
        if self._session.connected:
            message = self._session.on_lost(error)
            error = LinkError(message) if isinstance(error, LinkError) else error
        self._steps, self.error = None, error
        # A port that was unplugged comes back in seconds; each opening resets some boards.
        self._retry_at_s = self._clock.now_s() + RETRY_INTERVAL_S

    def compute_wait_s(self) -> float:
        """Return the longest time for which the next step may wait if no bytes arrive, s."""
        if self._session.connected:
            return self._session.compute_wait_s()
        return OPENING_WAIT_S if self._steps is None else self._wait_s
