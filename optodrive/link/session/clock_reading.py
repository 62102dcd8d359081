"""One moment on the clocks of board and host."""

from typing import NamedTuple


class ClockReading(NamedTuple):
    """The same moment on the board's clock, the host's monotonic clock (CLOCK_MONOTONIC) and in Unix time, s."""

    board_s: float
    monotonic_s: float
    unix_s: float

    def convert(self, board_s: float) -> "ClockReading":
        """Return another moment of the board's clock on all three. Its error grows with the distance and the drift."""
        elapsed_s = board_s - self.board_s
        return ClockReading(board_s, self.monotonic_s + elapsed_s, self.unix_s + elapsed_s)
