"""Priority of the daemon's processes on the processor."""

import os
from contextlib import suppress

NICE = -10
"""Priority of the processes on the way of a frame, as the systemd unit sets it; less than real time, which link has."""


def raise_priority(nice: int = NICE) -> None:
    """Raise the priority of this thread, and of the threads and processes that it starts, if that is permitted."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)
