"""Benchmark of STOP: time from sending it to dark by the board's log, at rest and under each flood of a caller.

Show, floods and STOPs share this computer, so each time is an upper bound: part of it is the wait for a core.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from rich.console import Console
from rich.table import Table

sys.path[:0] = [str(Path(__file__).resolve().parent.parent / "tests" / part) for part in ("system", "")]
from floods import FLOODS  # noqa: E402 - of the tests
from stop_rig import StopRig  # noqa: E402

SLEEPER = """
import os, sys, time
try:
    os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
except OSError:
    pass
late_s = [0.0]
os.set_blocking(0, False)
while sys.stdin.buffer.raw.read(1) is None:
    wake_s = time.monotonic() + 0.002
    time.sleep(0.002)
    late_s.append(time.monotonic() - wake_s)
print(max(late_s))
"""
"""A real-time process that only sleeps: its lateness is that of the computer, which no process of a daemon can beat."""


class Sleeper:
    """A process that measures how late the computer lets a real-time process run."""

    def __init__(self):
        self._process = subprocess.Popen(
            [sys.executable, "-c", SLEEPER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def finish(self):
        """Return the largest lateness, s."""
        return float(self._process.communicate(timeout=30)[0])


def format_ms(values, share):
    """Format the value below which a share of the values lies, ms."""
    ordered = sorted(values)
    return f"{1e3 * ordered[min(len(ordered) - 1, int(share * len(ordered)))]:.1f}" if ordered else "-"


def count_items(items):
    """Return the number of each distinct item, as text."""
    return ", ".join(f"{items.count(item)} {item}" for item in dict.fromkeys(items)) or "no"


def measure_flood(name, options):
    """Measure one flood on a new board and daemon; return its FloodResult."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        rig = StopRig(Path(folder), lease_s=options.lease_s)
        try:
            if options.path not in rig.senders:
                raise SystemExit(f"scripts/bench stop: --path {options.path}: this daemon has {', '.join(rig.senders)}")
            result = rig.run_flood(name, options.stops, options.seconds, options.watch_s, options.path)
        finally:
            with suppress(subprocess.TimeoutExpired):  # it did not end in time and was killed
                rig.close()
        return result


def build_row(result):
    """Return the cells of one flood."""
    counts = ", ".join(f"{key}: {value}" for key, value in sorted(result.counts.items(), key=lambda item: -item[1])[:4])
    return (
        result.name,
        str(len(result.gate_off_s)),
        *(format_ms(result.gate_off_s, share) for share in (0.5, 0.99, 1.0)),
        format_ms(result.answered_s, 0.99),
        count_items(result.darkened),
        str(result.not_begun),
        str(result.relit),
        counts,
    )


COLUMNS = ("flood", "n", "p50", "p99", "max", "answer p99", "dark?", "no show", "relit", "outcomes", "computer late")


def main():
    parser = argparse.ArgumentParser(prog="scripts/bench stop", description=__doc__)
    parser.add_argument("floods", nargs="*", metavar="FLOOD", help=f"rest, {', '.join(FLOODS)}; all by default")
    parser.add_argument("--stops", type=int, default=40, help="STOPs under each flood")
    parser.add_argument("--seconds", type=float, default=40.0, help="longest time of each flood")
    parser.add_argument("--watch-s", type=float, default=6.0, help="time of a show without STOP, first")
    parser.add_argument("--lease-s", type=float, default=0.1, help="lease; the shipped one by default")
    parser.add_argument("--path", default="http", help="way of STOP: http, or socket for the link process's own")
    parser.add_argument("--json", type=Path, help="file to which each flood's measurements are appended")
    options = parser.parse_args()
    unknown = [name for name in options.floods if name not in FLOODS and name != "rest"]
    if unknown:
        parser.error(f"FLOOD: got {unknown[0]!r}, expected one of rest, {', '.join(FLOODS)}")
    table = Table(*COLUMNS, title="STOP to dark by the board's log, ms")
    console = Console(width=190, file=sys.stdout)
    for name in options.floods or ("rest", *FLOODS):
        begin_s = time.monotonic()
        sleeper = Sleeper()
        try:
            result = measure_flood(name, options)
        finally:
            late_s = sleeper.finish()
        row = (*build_row(result), f"{1e3 * late_s:.0f}")
        table.add_row(*row)
        print(f"{time.monotonic() - begin_s:5.0f} s  {' | '.join(row)}", file=sys.stderr, flush=True)
        if result.darkened:
            print("\n".join(result.log[-10:]), file=sys.stderr, flush=True)
        if options.json:
            with options.json.open("a") as file:
                file.write(json.dumps(vars(result)) + "\n")
    console.print(table)
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores, including these processes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
