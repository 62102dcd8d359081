"""A transport without wires or waiting: the host reaches a simulated board in its own process, in virtual time."""

from optodrive.core.clock import ManualClock
from optodrive.link.simulator.board_core import BoardCore

EXCHANGE_MIN_S = 1e-4
"""What an exchange takes at least, so that time always moves."""


class MemoryLink:
    """Joins a host that waits on `read` to a `BoardCore`; reading moves the clock."""

    name = "simulated board, virtual time"

    def __init__(self, core: BoardCore, clock: ManualClock) -> None:
        self._core = core
        self._clock = clock

    def open(self) -> None:
        """Nothing to open."""

    def close(self) -> None:
        """The board hears that the host has gone."""
        self._core.on_link_lost(self._now_us())

    def release(self) -> None:
        """Nothing was started."""
        self.close()

    def _now_us(self) -> int:
        return round(self._clock.now_s() * 1e6)

    def write(self, data: bytes) -> None:
        """Bytes arrive at once."""
        self._core.receive(data, self._now_us())

    def read(self, timeout_s: float) -> bytes:
        """What the board has sent; time passes until it has, at most timeout_s."""
        self._clock.sleep(EXCHANGE_MIN_S)
        self._core.advance(self._now_us())
        data = self._core.bytes_to_send()
        if not data and timeout_s > EXCHANGE_MIN_S:
            self._clock.sleep(timeout_s - EXCHANGE_MIN_S)
            self._core.advance(self._now_us())
            data = self._core.bytes_to_send()
        return data
