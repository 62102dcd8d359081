"""Clock of a simulated board, whose oscillator is off, and wanders with the temperature."""

from math import cos, pi
from typing import NamedTuple

WANDER_PERIOD_S = 600.0


class BoardClock(NamedTuple):
    """Reading of a board's clock over true time, both from the board's start, s.

    drift, wander: constant relative error of the rate, and amplitude of one with a period of ten minutes
    offset_s: reading at the start
    """

    drift: float = 0.0
    wander: float = 0.0
    offset_s: float = 0.0

    def read_s(self, true_s: float) -> float:
        """Return the reading at a true time."""
        wandered_s = self.wander * WANDER_PERIOD_S / (2 * pi) * (1.0 - cos(2 * pi * true_s / WANDER_PERIOD_S))
        return self.offset_s + (1.0 + self.drift) * true_s + wandered_s

    def find_true_s(self, reading_s: float) -> float:
        """Return the true time of a reading."""
        true_s = reading_s - self.offset_s
        for _ in range(4):  # the rate differs from 1 by 1e-4 at most: each step adds four digits
            true_s += reading_s - self.read_s(true_s)
        return true_s


EXACT_CLOCK = BoardClock()
