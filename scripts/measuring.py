"""Harness of the benchmarks: rows of measured quantities, times of calls, an end to waiting, lateness, and a daemon."""

import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests" / part) for part in ("system", "browser", "blind", "")]

LEASE_S = 0.1
"""The shipped lease."""

# --- rows ------------------------------------------------------------------------------------------------------------


@dataclass
class Row:
    """A measured quantity, by one value or by several.

    aim: largest value that is aimed at; reference: of the ratio, with its values; late_s: lateness of the computer
    name: of the measurement
    """

    quantity: str
    values: list[float] | float
    unit: str = "ms"
    aim: float | None = None
    reference: str = ""
    reference_values: list[float] = field(default_factory=list)
    note: str = ""
    late_s: list[float] = field(default_factory=list)
    name: str = ""

    def report(self):
        """Return the row as JSON values. Times without a unit in their name are in the row's unit."""
        values = list(self.values) if isinstance(self.values, list) else [float(self.values)]
        p50, p99, largest = (_compute_share(values, share) for share in (0.5, 0.99, 1.0))
        reference, late_ms = _compute_share(self.reference_values, 0.5), to_ms(self.late_s)
        return {
            "name": self.name,
            "quantity": self.quantity,
            "unit": self.unit,
            "aim": self.aim,
            "n": len(values),
            "median": p50,
            "p99": p99,
            "max": largest,
            "misses_aim": self.aim is not None and (p99 is None or p99 > self.aim),
            "reference": self.reference or None,
            "reference_median": reference,
            "ratio": p50 / reference if p50 is not None and reference else None,
            "late_p99_ms": _compute_share(late_ms, 0.99),
            "late_max_ms": _compute_share(late_ms, 1.0),
            "note": self.note,
        }


HEADING = f"{'median':>10} {'p99':>10} {'max':>10} unit     n {'aim ≤':>8}   late p99, max, ms  ratio quantity"


def format_line(row):
    """Format a reported row under HEADING. ! marks a missed aim."""
    is_single = row["n"] == 1
    numbers = [format_number(row[key]) for key in (["median"] if is_single else ["median", "p99", "max"])]
    late = f"{format_number(row['late_p99_ms'])} {format_number(row['late_max_ms'])}"
    line = " ".join(f"{number:>10}" for number in [*numbers, "", ""][:3])
    line += f" {row['unit']:5}{'' if is_single else row['n']:>5} {format_number(row['aim']):>8} "
    line += f"{'!' if row['misses_aim'] else ' '} {late:>17} {format_number(row['ratio']):>6} {row['quantity']}"
    ends = [f", of {row['reference']}"] * bool(row["reference"]) + [f" ({row['note']})"] * bool(row["note"])
    return line + "".join(ends)


def format_number(value):
    return "" if value is None else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def to_ms(values_s):
    return [1e3 * value_s for value_s in values_s]


def compute_percentile(values, share):
    """Return the value below which a share of the values lies, or NaN without values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")


def _compute_share(values, share):
    return compute_percentile(values, share) if values else None


# --- times -----------------------------------------------------------------------------------------------------------


def measure_times_s(work, runs=7, clock=time.monotonic):
    """Return the duration of each of several calls, s."""
    times_s = []
    for _ in range(runs):
        begin_s = clock()
        work()
        times_s.append(clock() - begin_s)
    return times_s


def measure_median_cpu_s(work, runs=7):
    """Return the median CPU time of a call, s."""
    return statistics.median(measure_times_s(work, runs, time.process_time))


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
        command = [sys.executable, "-c", SLEEPER, *(["realtime"] if is_realtime else [])]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

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


# --- what is measured ------------------------------------------------------------------------------------------------


@contextmanager
def running_daemon(name="display-437", lease_s=LEASE_S, text="", prepare=None):
    """Run a daemon on a simulated board.

    text: further lines after the configuration's lease, and further sections; prepare: called with the board's log
    """
    from rig import running

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        if prepare is not None:
            prepare(Path(folder) / "board.jsonl")
        key = f"lease_s = {lease_s}"
        replace = [(key, f"{key}\n{text}\n#")] if text else ()
        with running(Path(folder), replace, name=name, lease_s=lease_s) as (board, daemon):
            yield board, daemon


def build_display(name="display-1511"):
    from optodrive.device.config_file import load_config
    from optodrive.planning.display_model import DisplayModel

    return DisplayModel.from_config(load_config(name))


def build_frames(targets_m, duration_s=10.0):
    """Return a sequence of frames of targets [p], m, without a pause between them."""
    from optodrive.core.types.stimuli import FrameSequence, TactileFrame

    frames = (TactileFrame(f"f{k}", 1e-3 * k, duration_s, target_m) for k, target_m in enumerate(targets_m))
    return FrameSequence(tuple(frames))
