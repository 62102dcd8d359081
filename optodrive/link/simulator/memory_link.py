"""In-memory transport to a simulated board in the same process, in virtual time."""

from optodrive.core.clock import ManualClock
from optodrive.link.simulator.board_core import BoardCore

EXCHANGE_MIN_S = 1e-4
"""Minimum duration of an exchange, so that virtual time always advances."""


class MemoryLink:
    """Connects a host to a `BoardCore`. `read` advances the clock."""

    name = "simulated board, virtual time"

    def __init__(self, core: BoardCore, clock: ManualClock) -> None:
        self._core = core
        self._clock = clock

    def open(self) -> None:
        """Do nothing: the link is always open."""

    def fileno(self) -> int | None:
        """Return None: nothing waits for this link."""
        return None

    def describe_fault(self) -> str:
        """Return an empty text, because this link has no faults."""
        return ""

    def close(self) -> None:
        """Report the loss of the link to the board."""
        self._core.on_link_lost(self._now_us())

    def release(self) -> None:
        """Close the link."""
        self.close()

    def _now_us(self) -> int:
        return round(self._clock.now_s() * 1e6)

    def write(self, data: bytes) -> None:
        """Pass bytes to the board without delay."""
        self._core.receive(data, self._now_us())

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that the board has sent, after at most timeout_s of virtual time."""
        self._clock.sleep(EXCHANGE_MIN_S)
        self._core.advance(self._now_us())
        data = self._core.bytes_to_send()
        if not data and timeout_s > EXCHANGE_MIN_S:
            self._clock.sleep(timeout_s - EXCHANGE_MIN_S)
            self._core.advance(self._now_us())
            data = self._core.bytes_to_send()
        return data
