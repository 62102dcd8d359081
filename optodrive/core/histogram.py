"""Counts of values by size, as monitoring wants them."""

from bisect import bisect_left
from itertools import accumulate


class Histogram:
    """How many values were at most each bound; one thread adds, any may read."""

    def __init__(self, bounds: tuple[float, ...]) -> None:
        self.bounds = bounds
        self.sum = 0.0
        self._counts = [0] * (len(bounds) + 1)

    def add(self, value: float) -> None:
        """Count a value."""
        self._counts[bisect_left(self.bounds, value)] += 1
        self.sum += value

    def cumulative_counts(self) -> list[int]:
        """Values at most each bound, and all of them at the end."""
        return list(accumulate(self._counts))
