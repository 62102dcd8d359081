"""Soak test: a board session streams pulses over pyserial and a pty to the process of the C core.

The pulses are short, so that millions take minutes. The width of each pulse encodes its number, which reveals missing,
repeated and reordered pulses. Two records are checked: the board's log, read by a separate process, and the reports
that the session receives. Exit status 1 where a pulse is missing or the board underran.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import measuring  # noqa: F401 - the folder of the tests
import numpy as np

from optodrive.core.clock import MonotonicClock
from optodrive.core.errors import OptodriveError
from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol.quantisation import CENTRE_CODE, WirePoints
from optodrive.link.protocol.states import IDLE_STATES, BoardState
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.serial_port import SerialPort
from process_memory import read_memory_mib  # of the tests

HOST_PORT = Path(__file__).parents[1] / "firmware_protocol" / "ports" / "host"
BAUD = 4_000_000
LIMITS = """
settle_us = 0
settle_ns_per_code = 0
rest_us = 0
lease_ms = 1000
queue_points = 32768
"""
PERIOD_US, WIDTH_US, WIDTHS, POSITIONS, POSITION_CODES, DUTY = 200, 50, 16, 4, 1400, 1000
PLAN_PULSES = 20_000
"""Pulses per plan; plans follow each other without a pause."""
LEAD_S = 0.5
OPTIONS = {"--pulses": {"type": int, "default": 2_000_000}}
STEP_S = 0.005
MEMORY_SAMPLES = 20
"""Number of memory samples."""


def build_points(first, count):
    """Build points from number `first` on, with widths and positions that encode their number."""
    number = np.arange(first, first + count)
    width = WIDTH_US + number % WIDTHS
    table = np.empty((count, 5), dtype=np.uint16)
    table[:, 0] = CENTRE_CODE + POSITION_CODES * (number % POSITIONS)
    table[:, 1] = CENTRE_CODE
    table[:, 2] = PERIOD_US - width
    table[:, 3] = width
    table[:, 4] = DUTY
    return WirePoints(table, np.arange(count))


def build_requirements(baud):
    """Build the board requirements of a scanner that is fast enough for the test."""
    config = load_config("display-437")
    scanner = config.scanner.model_copy(
        update={"bandwidth_hz": 1e5, "slew_rad_per_s": 1000.0, "delay_s": 1e-6},
    )
    limits = config.limits.model_copy(update={"pulse_gap_min_s": 1e-4})
    board = config.board.model_copy(update={"baud": baud, "lease_s": 1.0})
    return build_board_requirements(config.model_copy(update={"scanner": scanner, "limits": limits, "board": board}))


def check_log(log):
    """Read the log to its end, and print the counts of pulses, pulses out of order, HOLDs and faults as JSON."""
    pulses = out_of_order = holds = faults = 0
    pulse = re.compile(r'"index": (\d+).*"on_us": (\d+), "off_us": (\d+)')
    with Path(log).open() as lines:
        for line in lines:
            if '"event": "pulse"' in line:
                index, on_us, off_us = map(int, pulse.search(line).groups())
                out_of_order += index != pulses or off_us - on_us != WIDTH_US + index % WIDTHS
                pulses += 1
            else:
                holds += '"state": "HOLD"' in line
                faults += '"event": "fault"' in line
    print(json.dumps({"pulses": pulses, "out_of_order": out_of_order, "holds": holds, "faults": faults}))


class SoakBoard:
    """The board process on a pty, and the process that checks its log."""

    def __init__(self, folder):
        subprocess.run(["make", "-s", "-C", HOST_PORT, f"BUILD={folder}"], check=True)
        self.port, log, limits = folder / "tty", folder / "log", folder / "limits.toml"
        limits.write_text(LIMITS)
        os.mkfifo(log)
        self._log_checker = subprocess.Popen([sys.executable, __file__, log], stdout=subprocess.PIPE, text=True)
        options = ["--pty", self.port, "--log", log, "--limits", limits, "--baud", str(BAUD)]
        self.board = subprocess.Popen([folder / "board", *options])
        while not self.port.exists() and self.board.poll() is None:
            time.sleep(0.01)

    def finish(self):
        """End the board, and return the counts of the log."""
        self.board.terminate()
        self.board.wait()
        return json.loads(self._log_checker.communicate()[0])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in (self.board, self._log_checker):
            if process.poll() is None:
                process.kill()
                process.wait()


# --- the host --------------------------------------------------------------------------------------------------------


class ReportChecker:
    """Checks that the reports to the session contain every pulse, in order and as requested."""

    def __init__(self, scale):
        self._scale = scale
        self._last_us = -1
        self.pulses = self.out_of_order = 0

    def check_plan(self, job, count):
        """Check a finished plan of `count` pulses."""
        plan = SimpleNamespace(pixel=np.arange(count), start_s=np.zeros(count))  # the starts of dark points alone count
        done = job.build_executed(plan, self._scale.full_power_w, self._scale.tick_s)
        on_us, width_us = done.on_tick, done.width_ticks
        ends_us = np.concatenate([[self._last_us], (on_us + width_us)[:-1]])
        wrong = (on_us < ends_us) | (width_us != WIDTH_US + (job.first_index + done.pixel) % WIDTHS)
        self.out_of_order += int(wrong.sum()) + (not done.complete)
        self.pulses += len(done)
        self._last_us = int(on_us[-1] + width_us[-1])


class SoakRun:
    """Streams pulses through a session, plan after plan."""

    def __init__(self, session, total, lead_s, on_progress):
        self._session, self._total, self._on_progress = session, total, on_progress
        self._lead_s = lead_s
        self._jobs = []
        self._submitted = 0
        self.reports = ReportChecker(session.scale)

    def _submit_next(self):
        """Submit the next plan once half of the last one is sent."""
        count = min(PLAN_PULSES, self._total - self._submitted)
        if not self._jobs:
            job = self._session.begin(build_points(self._submitted, count), self._session.board_s() + self._lead_s)
        else:
            last, last_count = self._jobs[-1]
            if last.end_index - last.next_to_send > PLAN_PULSES // 2:
                return
            job = self._session.splice(build_points(self._submitted, count), last_count, float("inf"))
            if job is None:
                raise RuntimeError("a plan was too late to follow the previous one")
        self._jobs.append((job, count))
        self._submitted += count

    def run(self):
        """Arm, and stream until every pulse is reported, or the board is no longer armed."""
        self._session.connect()
        self._session.arm()
        while self._session.board.state != BoardState.ARMED:
            self._session.step(STEP_S, renew_lease=True)
        samples = 0
        while self._submitted < self._total or self._jobs:
            if self._submitted < self._total:
                self._submit_next()
            self._session.step(STEP_S, renew_lease=True)
            while self._jobs and self._jobs[0][0].is_finished:
                self.reports.check_plan(*self._jobs.pop(0))
            if self._session.board.state in IDLE_STATES:
                return
            done = self._session.board.done_index
            if done >= samples * self._total / MEMORY_SAMPLES:
                self._on_progress()
                samples += 1


def run_soak(total, lead_s=LEAD_S):
    """Run the test. Return the rows and the failures.

    lead_s: time from the first point to the start
    """
    memory = {"host": [], "board": []}
    with tempfile.TemporaryDirectory() as folder, SoakBoard(Path(folder)) as board_process:
        session = BoardSession(SerialPort(str(board_process.port), BAUD), MonotonicClock(), build_requirements(BAUD))

        def sample_memory():
            memory["host"].append(read_memory_mib("self")[1])
            memory["board"].append(read_memory_mib(board_process.board.pid)[1])

        run = SoakRun(session, total, lead_s, sample_memory)
        start_s, start_cpu_s = time.monotonic(), time.process_time()
        try:
            run.run()
        except OptodriveError as error:
            print(error, file=sys.stderr)
        duration_s, cpu_s = time.monotonic() - start_s, time.process_time() - start_cpu_s
        board, stats, reports = session.board, session.collect_link_stats(), run.reports
        session.close()
        log_result = board_process.finish()
    rows = [
        ("pulses requested", total, "1"),
        ("pulses in the board's log", log_result["pulses"], "1"),
        ("of them out of order, or of wrong width", log_result["out_of_order"], "1"),
        ("pulses reported to the session", reports.pulses, "1"),
        ("of them overlapping, or of wrong width", reports.out_of_order, "1"),
        ("underruns", board.underruns, "1"),
        ("HOLDs in the log", log_result["holds"], "1"),
        ("faults", log_result["faults"], "1"),
        ("retransmissions", stats["retransmitted"], "1"),
        ("NAKs", stats["naks"], "1"),
        ("bad frames", stats["host_bad_frames"] + stats["board_bad_frames"], "1"),
        ("longest stall of the host", stats["longest_stall_ms"], "ms"),
        ("duration", duration_s, "s"),
        ("pulses per second", reports.pulses / duration_s, "1/s"),
        ("host's CPU time per 1,000 pulses", 1000 * cpu_s / max(1, reports.pulses), "s CPU"),
    ]
    for name, samples_mib in memory.items():
        for share in (0.05, 0.5, 1.0) if samples_mib else ():
            sample_mib = samples_mib[round(share * (len(samples_mib) - 1))]
            rows.append((f"resident memory of the {name} at {share:.0%}", sample_mib, "MiB"))
    failures = {
        "pulses are missing": {log_result["pulses"], reports.pulses} != {total},
        "pulses are out of order, or not as requested": log_result["out_of_order"] or reports.out_of_order,
        "the board underran": board.underruns or log_result["holds"],
        "the board was in FAULT": log_result["faults"],
    }
    return rows, [message for message, failed in failures.items() if failed]


def measure(pulses):
    if pulses < 1:
        raise SystemExit(f"--pulses: got {pulses}, expected at least 1")
    rows, failures = run_soak(pulses)
    yield from rows
    if failures:
        raise SystemExit(f"FAILED: {', '.join(failures)}")


if __name__ == "__main__":
    check_log(sys.argv[1])
