"""Priority of threads on the processor."""

import os
from contextlib import suppress

USUAL, PLANNING, LIGHT = 0, 1, 2
"""Priorities: of all other programs, of the planning of streams, and of what renews the lease or makes dark."""


def set_realtime_priority(priority: int) -> None:
    """Set the real-time priority of this thread, USUAL for none. The nice value is kept.

    Threads that it starts later inherit it; otherwise a preempted thread could hold the interpreter lock. Without the
    permission, scheduling stays as it is, and the lease tolerates less load by other programs.
    """
    policy = os.SCHED_OTHER if priority == USUAL else os.SCHED_RR
    with suppress(OSError):
        os.sched_setscheduler(0, policy, os.sched_param(priority))


def set_nice(nice: int) -> None:
    """Set the niceness of this thread and of all threads and processes that it starts later, if that is permitted."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)


def use_usual_priority() -> None:
    """Give this thread the priority of all other programs, also if it inherited another."""
    set_realtime_priority(USUAL)


def has_realtime_priority() -> bool:
    """Return whether this thread runs before all programs of usual priority."""
    return os.sched_getscheduler(0) in (os.SCHED_RR, os.SCHED_FIFO)
