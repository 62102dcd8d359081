"""Histogram with cumulative counts, as Prometheus defines it."""

from bisect import bisect_left
from itertools import accumulate


class Histogram:
    """Counts of values up to each bound. One thread may add, any thread may read."""

    def __init__(self, bounds: tuple[float, ...]) -> None:
        self.bounds = bounds
        self.sum = 0.0
        self._counts = [0] * (len(bounds) + 1)

    def add(self, value: float) -> None:
        """Count a value."""
        self._counts[bisect_left(self.bounds, value)] += 1
        self.sum += value

    def cumulative_counts(self) -> list[int]:
        """Return the number of values up to each bound, followed by the number of all values."""
        return list(accumulate(self._counts))

    @property
    def counts(self) -> list[int]:
        """Number of values in each interval, the last one without an upper bound."""
        return list(self._counts)

    def load(self, counts: list[int], total: float) -> None:
        """Replace the contents by the counts and the sum of another histogram with the same bounds."""
        self._counts, self.sum = list(counts), total
