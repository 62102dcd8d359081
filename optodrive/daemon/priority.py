"""Priority of the daemon's processes on the processor."""

import os
from contextlib import suppress

NICE = -10
"""Priority of the daemon's processes, as the systemd unit sets it; less than real time, which link has."""


def raise_priority() -> None:
    """Raise the priority of this thread, and of the threads and processes that it starts, if that is permitted."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
