"""A long run: the real session, over pyserial and a pty, streams to the C core's process until every pulse is through.

The pulses are short and the board's limits such that millions pass in minutes; each has a width that tells its number,
so that one that is missing, doubled or out of order shows. Twice: in the board's own log, which a process of its own
reads as it is written, and in the reports that the session gets. Exit 1 where a pulse is missing or the board ran dry.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from rich.console import Console
from rich.table import Table

from optodrive.core.clock import MonotonicClock
from optodrive.core.errors import OptodriveError
from optodrive.device.config import load_config
from optodrive.link.protocol.quantisation import CENTRE_CODE, WirePoints
from optodrive.link.session.board_requirements import Requirements
from optodrive.link.session.session import Session
from optodrive.link.transport.serial_port import SerialPort

HOST_PORT = Path(__file__).parents[1] / "firmware_protocol" / "ports" / "host"
BAUD = 4_000_000
LIMITS = """
settle_us = 0
settle_ns_per_code = 0
rest_us = 0
lease_ms = 1000
queue_points = 32768
"""
PERIOD_US, WIDTH_US, WIDTHS, PLACES, PLACE_CODES, DUTY = 200, 50, 16, 4, 1400, 1000
CHUNK = 20_000
"""Pulses of one plan; the next one follows it without a pause."""
LEAD_S = 0.5
STEP_S = 0.005
LOOKS = 20
"""How often memory is looked at."""


def points(first, count):
    """Points from number `first` on: a width and a place that tell their number."""
    number = np.arange(first, first + count)
    width = WIDTH_US + number % WIDTHS
    table = np.empty((count, 5), dtype=np.uint16)
    table[:, 0] = CENTRE_CODE + PLACE_CODES * (number % PLACES)
    table[:, 1] = CENTRE_CODE
    table[:, 2] = PERIOD_US - width
    table[:, 3] = width
    table[:, 4] = DUTY
    return WirePoints(table, np.arange(count))


def requirements(baud):
    """What a host asks that has mirrors quick enough for it."""
    config = load_config("display-437")
    scanner = config.scanner.model_copy(
        update={"bandwidth_hz": 1e5, "slew_rad_per_s": 1000.0, "delay_s": 1e-6},
    )
    limits = config.limits.model_copy(update={"pulse_rest_min_s": 1e-4})
    board = config.board.model_copy(update={"baud": baud, "lease_s": 1.0})
    return Requirements.of(config.model_copy(update={"scanner": scanner, "limits": limits, "board": board}))


# --- the board's process, and the witness that reads its log ---------------------------------------------------------


def witness(log):
    """Read the log to its end; as JSON: pulses, those that are not the next one in order, HOLDs, faults."""
    pulses = astray = holds = faults = 0
    pulse = re.compile(r'"index": (\d+).*"on_us": (\d+), "off_us": (\d+)')
    with Path(log).open() as lines:
        for line in lines:
            if '"event": "pulse"' in line:
                index, on_us, off_us = map(int, pulse.search(line).groups())
                astray += index != pulses or off_us - on_us != WIDTH_US + index % WIDTHS
                pulses += 1
            else:
                holds += '"state": "HOLD"' in line
                faults += '"event": "fault"' in line
    print(json.dumps({"pulses": pulses, "astray": astray, "holds": holds, "faults": faults}))


class Bench:
    """The board's process on a pty and its witness; both ended whatever happens."""

    def __init__(self, folder):
        subprocess.run(["make", "-s", "-C", HOST_PORT, f"BUILD={folder}"], check=True)
        self.port, log, limits = folder / "tty", folder / "log", folder / "limits.toml"
        limits.write_text(LIMITS)
        os.mkfifo(log)
        self._witness = subprocess.Popen(
            [sys.executable, __file__, "--witness", log], stdout=subprocess.PIPE, text=True
        )
        options = ["--pty", self.port, "--log", log, "--limits", limits, "--baud", str(BAUD)]
        self.board = subprocess.Popen([folder / "board", *options])
        while not self.port.exists() and self.board.poll() is None:
            time.sleep(0.01)

    def end(self):
        """What the witness saw."""
        self.board.terminate()
        self.board.wait(timeout=10)
        return json.loads(self._witness.communicate(timeout=60)[0])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in (self.board, self._witness):
            if process.poll() is None:
                process.kill()
                process.wait()


def memory_mib(process):
    """Resident memory of a process."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+) kB", status)[1]) / 1024


# --- the host --------------------------------------------------------------------------------------------------------


class Reports:
    """What the session was told of plans that are through: whether each pulse is there, in order and as asked."""

    def __init__(self, scale):
        self._scale = scale
        self._last_us = -1
        self.pulses = self.astray = 0

    def take(self, job, count):
        """A plan that is finished, with so many pulses."""
        done = job.executed(SimpleNamespace(pixel=np.arange(count)), self._scale.full_power_w, self._scale.tick_s)
        on_us, width_us = done.on_tick, done.width_ticks
        ends_us = np.concatenate([[self._last_us], (on_us + width_us)[:-1]])
        wrong = (on_us < ends_us) | (width_us != WIDTH_US + done.index % WIDTHS)
        self.astray += int(wrong.sum()) + (not done.complete)
        self.pulses += len(done)
        self._last_us = int(on_us[-1] + width_us[-1])


class Run:
    """Pulses through a session, plan after plan."""

    def __init__(self, session, total, look):
        self._session, self._total, self._look = session, total, look
        self._jobs = []
        self._asked = 0
        self.reports = Reports(session.scale)

    def _next(self):
        """The next plan: behind the last one while that one is not wholly sent."""
        count = min(CHUNK, self._total - self._asked)
        if not self._jobs:
            job = self._session.begin(points(self._asked, count), self._session.board_s() + LEAD_S)
        else:
            last, kept = self._jobs[-1]
            if last.end_index - last.next_to_send > CHUNK // 2:
                return
            job = self._session.follow(points(self._asked, count), kept, float("inf"))
            if job is None:
                raise RuntimeError("a plan came too late to follow the one before it")
        self._jobs.append((job, count))
        self._asked += count

    def through(self):
        """Until every pulse is reported, or the board is no longer armed."""
        looked = 0
        while self._asked < self._total or self._jobs:
            if self._asked < self._total:
                self._next()
            self._session.step(STEP_S, lease=True)
            while self._jobs and self._jobs[0][0].finished:
                self.reports.take(*self._jobs.pop(0))
            if self._session.board.state in ("DISARMED", "FAULT"):
                return
            done = self._session.board.done_index
            if done >= looked * self._total / LOOKS:
                self._look(done / self._total)
                looked += 1


def arm(session):
    """Until the board is armed."""
    session.connect()
    session.arm()
    while session.board.state != "ARMED":
        session.step(STEP_S, lease=True)


def soak(total):
    """Rows of the table, and what failed."""
    memory = []
    with tempfile.TemporaryDirectory() as folder, Bench(Path(folder)) as bench:
        session = Session(SerialPort(str(bench.port), BAUD), MonotonicClock(), requirements(BAUD))
        arm(session)

        def look(share):
            memory.append((share, memory_mib(os.getpid()), memory_mib(bench.board.pid)))

        run = Run(session, total, look)
        began_s, began_cpu_s = time.monotonic(), time.process_time()
        try:
            run.through()
        except OptodriveError as error:
            print(error, file=sys.stderr)
        took_s, cpu_s = time.monotonic() - began_s, time.process_time() - began_cpu_s
        board, figures = session.board, session.link_figures()
        session.close()
        seen = bench.end()
    rows = [
        ("pulses asked", total),
        ("pulses in the board's log", seen["pulses"]),
        ("  of them not the next one in order, or of another width", seen["astray"]),
        ("pulses reported to the session", run.reports.pulses),
        ("  of them not after the one before, or of another width", run.reports.astray),
        ("underruns; HOLDs in the log; faults", f"{board.underruns}; {seen['holds']}; {seen['faults']}"),
        ("frames sent again; NAKs; bad frames", f"{figures['retransmitted']}; {figures['naks']}; {_bad(figures)}"),
        ("longest time between two turns of the host, ms", f"{figures['longest_stall_ms']:.0f}"),
        ("duration, s; pulses a second", f"{took_s:.0f}; {run.reports.pulses / took_s:.0f}"),
        ("host's CPU time a thousand pulses, s", f"{1000 * cpu_s / max(1, run.reports.pulses):.3f}"),
    ]
    for name, at in (("host", 1), ("board", 2)):
        rows.append((f"resident memory of the {name} at 5, 50, 100 %, MiB", _over_time(memory, at)))
    judged = {
        "pulses are missing": {seen["pulses"], run.reports.pulses} != {total},
        "pulses are out of order, or not as asked": seen["astray"] or run.reports.astray,
        "the board ran out of points": board.underruns or seen["holds"],
        "the board was in fault": seen["faults"],
    }
    return rows, [what for what, failed in judged.items() if failed]


def _bad(figures):
    return figures["received_bad"] + figures["board_bad"]


def _over_time(memory, at):
    chosen = [min(memory, key=lambda look: abs(look[0] - share)) for share in (0.05, 0.5, 1.0)] if memory else []
    return ", ".join(f"{look[at]:.1f}" for look in chosen)


def main():
    parser = argparse.ArgumentParser(prog="scripts/bench soak")
    parser.add_argument("--pulses", type=int, default=2_000_000)
    parser.add_argument("--witness", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.witness:
        witness(options.witness)
        return 0
    if options.pulses < 1:
        parser.error(f"--pulses: got {options.pulses}, expected at least 1")
    rows, failed = soak(options.pulses)
    table = Table("soak", "")
    for name, value in rows:
        table.add_row(name, str(value))
    Console(width=120).print(table)
    for what in failed:
        print(f"FAILED: {what}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
