"""Time that is reserved for the planning of a streamed plan, and time of a frame that is planned at once."""

from collections import deque
from math import inf

INITIAL_S = 0.01
RECENT_MAX = 8
FACTOR = 1.25
"""Time reserved per time expected, for a plan that takes longer than the recent ones."""

HORIZON_MIN_S, HORIZON_MAX_S = 0.05, 0.1
"""Light of a frame that is planned at once, at least and at most."""
HORIZON_INTERVALS = 1.5
"""The same, in intervals between two frames: a frame that comes somewhat later than expected finds it unspent."""


class StreamHorizon:
    """Time of a streamed frame's light that is planned at once, from the interval between the last two frames."""

    def __init__(self) -> None:
        self._arrived_s = -inf

    def follow(self, arrived_s: float) -> float:
        """Return the time for the frame that arrived now, s."""
        interval_s, self._arrived_s = arrived_s - self._arrived_s, arrived_s
        return min(HORIZON_MAX_S, max(HORIZON_MIN_S, HORIZON_INTERVALS * interval_s))


class PlanningTime:
    """Expected duration of the next planning, from the recent ones.

    A plan that is late is made again, which takes longer than to wait for it: the expectation is the second longest of
    the recent durations, so that one of them in eight may be exceptional.
    """

    def __init__(self) -> None:
        self._recent_s = deque([INITIAL_S], RECENT_MAX)

    def record(self, duration_s: float) -> None:
        """Record the duration of a planning, s."""
        self._recent_s.append(duration_s)

    def compute_reserved_s(self, late_count: int) -> float:
        """Return the time to reserve for a plan that was late `late_count` times, s."""
        expected_s = sorted(self._recent_s)[-2] if len(self._recent_s) > 1 else self._recent_s[0]
        return FACTOR * (1 + late_count) * expected_s
