"""Numbers of fingertips in successive pictures: the nearest one of before keeps its number."""

import numpy as np

from optodrive.core.types.arrays import FloatArray

JUMP_MAX_M = 0.02
"""Largest way between two pictures. One that is farther from all others is a new fingertip."""
MISSED_MAX_S = 0.1
"""Time for which the number of a fingertip that is not found is kept."""


class FingerNumbers:
    """Numbers fingertips. Times are of one clock, and do not decrease."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[float, FloatArray]] = {}
        self._next = 0

    def assign(self, at_s: float, places_m: FloatArray) -> list[int]:
        """Return the numbers of places [n, 2] at a time. The closest pairs of old and new places are the same."""
        self._last = {number: last for number, last in self._last.items() if at_s - last[0] <= MISSED_MAX_S}
        pairs = sorted(
            (float(np.hypot(*(place_m - last_m))), number, row)
            for number, (_, last_m) in self._last.items()
            for row, place_m in enumerate(places_m)
        )
        numbers: dict[int, int] = {}
        for distance_m, number, row in pairs:
            if distance_m <= JUMP_MAX_M and row not in numbers and number not in numbers.values():
                numbers[row] = number
        for row, place_m in enumerate(places_m):
            if row not in numbers:
                numbers[row], self._next = self._next, self._next + 1
            self._last[numbers[row]] = (at_s, place_m)
        return [numbers[row] for row in range(len(places_m))]
