"""Host time, injected: the real monotonic clock, or one that tests and simulations move by hand.

Three time bases exist, and names tell them apart: `host_s` (monotonic, this module), `plan_s`
(seconds from a plan's start) and `tick` (the board's counter).
"""

import os
import time
from contextlib import suppress
from typing import Protocol


class Clock(Protocol):
    """What the package asks of a clock."""

    def now_s(self) -> float:
        """Monotonic time, s."""

    def sleep(self, duration_s: float) -> None:
        """Let `duration_s` seconds pass."""


class MonotonicClock:
    """The machine's monotonic clock."""

    def now_s(self) -> float:
        """Monotonic time, s."""
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Block for `duration_s` seconds."""
        time.sleep(duration_s)


class ManualClock:
    """A clock that moves only when told."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now_s(self) -> float:
        """Time as last set, s."""
        return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Advance by `duration_s` seconds at once."""
        self._now_s += duration_s


def request_realtime_scheduling() -> None:
    """Ask that this thread need not wait for the processor behind others: whoever renews a lease must not be late.

    Threads that it starts later inherit it, so that none of them holds the interpreter while it waits itself. Where it
    may not be asked for it stays as it is, and the lease bears less of other programs' work.
    """
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
