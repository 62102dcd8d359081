"""Host time, injected: the monotonic clock, or one that tests and simulations advance.

Names distinguish three time bases: `host_s` (monotonic, this module), `plan_s` (seconds from a plan's start) and `tick`
(the board's counter).
"""

import time
from typing import Protocol


class Clock(Protocol):
    """Interface of a clock."""

    def now_s(self) -> float:
        """Return the monotonic time, s."""

    def sleep(self, duration_s: float) -> None:
        """Wait for `duration_s`."""


class MonotonicClock:
    """The monotonic clock of the operating system."""

    def now_s(self) -> float:
        """Return the monotonic time, s."""
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Block for `duration_s`."""
        time.sleep(duration_s)


class ManualClock:
    """A clock that advances only through `sleep`."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now_s(self) -> float:
        """Return the current time of the clock, s."""
        return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Advance by `duration_s` without waiting."""
        self._now_s += duration_s
