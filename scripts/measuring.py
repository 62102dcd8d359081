"""Tools that benchmarks share: an end to waiting, times of calls, the lateness of the computer, and percentiles."""

import json
import os
import signal
import statistics
import subprocess
import sys
import time
from contextlib import contextmanager, suppress

SLEEPER = """
import json, os, sys, time
if sys.argv[1:]:
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except OSError:
        pass
os.set_blocking(0, False)
late_s = []
while sys.stdin.buffer.raw.read(1) is None:
    wake_s = time.monotonic() + 0.002
    time.sleep(0.002)
    late_s.append(time.monotonic() - wake_s)
print(json.dumps([*late_s[:: max(1, len(late_s) // 100_000)], max(late_s, default=0.0)]))
"""


class Sleeper:
    """A process that only sleeps: how late it wakes is the computer's lateness, which no other process can beat.

    is_realtime: with real-time priority, where that is permitted
    """

    def __init__(self, is_realtime=False):
        self._process = subprocess.Popen(
            [sys.executable, "-c", SLEEPER, *(["realtime"] if is_realtime else [])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def finish(self):
        """End the process and return its lateness at many times, s, with the largest."""
        return json.loads(self._process.communicate()[0])


@contextmanager
def time_limit(limit_s):
    """Raise TimeoutError in this block after a time, wherever the main thread waits. Such blocks may be nested."""

    def end(*_):
        raise TimeoutError(f"it took longer than {limit_s:g} s")

    begin_s = time.monotonic()
    previous = signal.signal(signal.SIGALRM, end)
    outer_s, _ = signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)
        if outer_s:
            signal.setitimer(signal.ITIMER_REAL, max(1e-3, outer_s - (time.monotonic() - begin_s)))


@contextmanager
def realtime_priority():
    """Run this block before all programs of usual priority, where that is permitted. Processes it starts do not."""
    scheduling = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    try:
        yield
    finally:
        os.sched_setscheduler(0, *scheduling)


def measure_median_cpu_s(work, runs=7):
    """Return the median CPU time of a call, s."""
    times_s = []
    for _ in range(runs):
        begin_s = time.process_time()
        work()
        times_s.append(time.process_time() - begin_s)
    return statistics.median(times_s)


def compute_percentile(values, share):
    """Return the value below which a share of the values lies, or NaN without values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")
