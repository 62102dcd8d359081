"""Priority of threads, rare collections of garbage, and the state of other processes."""

import gc
import os
from contextlib import suppress
from pathlib import Path


def is_suspended(pid: int | None) -> bool:
    """Return whether a signal, such as SIGSTOP, has stopped a process. Return False for one that does not exist."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "Tt"
    except (OSError, IndexError):
        return False


USUAL, PLANNING, LIGHT = 0, 1, 2
"""Priorities: of all other programs, of the planning of streams, and of what renews the lease or makes dark."""


def set_realtime_priority(priority: int) -> None:
    """Set the real-time priority of this thread, USUAL for none. The nice value is kept.

    Threads that it starts later inherit it; otherwise a preempted thread could hold the interpreter lock. Without the
    permission, scheduling stays as it is, and the lease tolerates less load by other programs.
    """
    # Round robin: of several threads at one priority none waits for another to sleep.
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


USUAL_THRESHOLDS = (700, 10, 10)
"""Those of Python 3.11."""
COMMAND_THRESHOLD = 200_000
"""Objects created, less those deleted, between two collections; some 30 MiB of small ones."""


def collect_seldom() -> None:
    """Make collections of garbage rare in this process.

    What imports create is no garbage, and searching it again and again takes a quarter of the time of `optodrive plan`.
    """
    gc.set_threshold(COMMAND_THRESHOLD)


def settle_memory() -> None:
    """Collect the garbage of the start, and exempt all other objects from later collections.

    A collection would visit them for milliseconds, and in a fork copy every page. Later objects are collected as usual.
    """
    gc.set_threshold(*USUAL_THRESHOLDS)
    gc.collect()
    # After the collection: what is garbage now would else be kept for good.
    gc.freeze()


def skip_last_collection() -> None:
    """Exempt all objects from the collection at the interpreter's exit."""
    gc.freeze()
