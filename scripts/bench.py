"""Benchmarks: medians of several runs, CPU time of one core unless a row says otherwise."""

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from optodrive.board.requirements import Requirements
from optodrive.config import load_config
from optodrive.flow import FrameSequence, TactileFrame
from optodrive.limit.limiter import limit, verify
from optodrive.pipeline import Display, prepare
from optodrive.plan.scheduler import Scheduler
from optodrive.simulator.run import execute
from optodrive.wire.quantise import decode, quantise

RUNS = 7


def median_s(work) -> float:
    """Median CPU seconds of a call."""
    times = []
    for _ in range(RUNS):
        begin_s = time.process_time()
        work()
        times.append(time.process_time() - begin_s)
    return statistics.median(times)


def full_frame(name="display-1511", height_m=50e-6):
    display = Display.of(load_config(name))
    count = len(display.layout)
    return display, FrameSequence((TactileFrame("full", 0.0, 10.0, np.full(count, height_m)),))


def child_cpu_s(arguments) -> float:
    def used():
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    before_s = used()
    subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL)
    return used() - before_s


def plan_rows(height_um):
    display, sequence = full_frame(height_m=height_um * 1e-6)
    heat, budget = display.at_rest()
    prepared = prepare(display, sequence, heat, budget)
    piece = next(iter(Scheduler(display.machine, sequence).pieces(heat.copy())))
    count = len(prepared.plan)
    schedule_s = median_s(lambda: list(Scheduler(display.machine, sequence).pieces(heat.copy())))
    limit_s = median_s(lambda: limit(piece, budget, display.budget))
    whole_s = median_s(lambda: prepare(display, sequence, heat, budget))
    return [
        (f"{height_um} µm: pulses planned a second", count / schedule_s, "1/s"),
        (f"{height_um} µm: pulses limited a second", count / limit_s, "1/s"),
        (f"{height_um} µm: planned, limited and predicted a second", count / whole_s, "1/s"),
        (f"{height_um} µm: beam-on share of the plan", prepared.plan.width_s.sum() / prepared.duration_s, "1"),
        (f"{height_um} µm: pixels shown a second of the plan", count / prepared.duration_s, "1/s"),
    ]


def bench_plan():
    """A full 1,511-pixel frame: planned, limited, predicted; and the whole command from the shell."""
    rows = [row for height_um in (50, 100, 400) for row in plan_rows(height_um)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.json"
        path.write_text(json.dumps({"frames": [{"show_at_s": 0, "duration_s": 10, "target_um": [50.0] * 1511}]}))
        command = [Path(sys.executable).with_name("optodrive"), "plan", path, "--config", "display-1511"]
        cpu_s = statistics.median(child_cpu_s(command) for _ in range(RUNS))
    return [*rows, ("optodrive plan, 1,511 pixels at 50 µm, the whole command", cpu_s, "s CPU")]


def bench_wire():
    """From limited plan to bytes, and the proof that reads them back."""
    display, sequence = full_frame()
    heat, budget = display.at_rest()
    plan = prepare(display, sequence, heat, budget).plan
    scale = Requirements.of(display.config).scale
    points = quantise(plan, scale)
    payload = b"".join(body for _, body, _ in points.frames(0))

    def prove():
        decoded = decode(payload, scale)
        pixel = plan.pixel[points.row[decoded.index]].tolist()
        verify(pixel, decoded.start_s, decoded.width_s, decoded.power_w, budget, display.budget)

    return [
        ("pulses quantised a second", len(plan) / median_s(lambda: quantise(plan, scale)), "1/s"),
        ("pulses decoded and proven a second", len(plan) / median_s(prove), "1/s"),
        ("bytes of points a pulse", len(payload) / len(plan), "B"),
    ]


def bench_board():
    """The real session and the simulated board in virtual time."""
    display, sequence = full_frame()
    prepared = prepare(display, sequence, *display.at_rest())
    seconds = median_s(lambda: execute(display, prepared))
    return [
        ("pulses through session and simulated board a second", len(prepared.plan) / seconds, "1/s"),
        ("times real time", prepared.duration_s / seconds, "×"),
    ]


BENCHMARKS = {"plan": bench_plan, "wire": bench_wire, "board": bench_board}


def main() -> int:
    parser = argparse.ArgumentParser(prog="scripts/bench", description=__doc__)
    parser.add_argument("name", nargs="?", choices=sorted(BENCHMARKS))
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    results = {name: run() for name, run in BENCHMARKS.items() if options.name in (None, name)}
    if options.json:
        print(json.dumps({name: [list(row) for row in rows] for name, rows in results.items()}, indent=2))
        return 0
    table = Table("benchmark", "what", "median", "unit")
    for name, rows in results.items():
        for what, value, unit in rows:
            table.add_row(name, what, f"{value:,.3g}" if value < 1000 else f"{value:,.0f}", unit)
    Console(width=120).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
