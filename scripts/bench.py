"""Benchmarks: medians of several runs, CPU time of one core unless a row states otherwise."""

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
from bench_field import bench_field
from bench_memory import bench_memory
from bench_stream import bench_stream
from measuring import measure_median_cpu_s
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp
from scipy.sparse import csr_array

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config_file import load_config
from optodrive.device.neighbours import Neighbours
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol.quantisation import decode, quantise
from optodrive.link.simulator.virtual_run import execute
from optodrive.physics.nominal_display import NominalThermalState
from optodrive.physics.parameters import load_parameters
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.limiter import limit, shift_state, verify
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler.scheduler import Scheduler

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from reference_models.coupled_display import CoupledDisplay, Modes, WallParameters, build_conductances_w_per_k

RUNS = 7


def build_full_frame(name="display-1511", height_m=50e-6):
    """Return a display and a sequence of one frame with the same target on every pixel."""
    display = DisplayModel.from_config(load_config(name))
    count = len(display.layout)
    return display, FrameSequence((TactileFrame("full", 0.0, 10.0, np.full(count, height_m)),))


def measure_child_cpu_s(arguments) -> float:
    """Return the CPU time of a command, s."""

    def read_cpu_s():
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    before_s = read_cpu_s()
    subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL)
    return read_cpu_s() - before_s


def schedule_batches(display, sequence, heat):
    """Return an iterator over the batches of a plan without the limiter."""
    scheduler = Scheduler(display.scan_heads, display.build_assignment(sequence), sequence, display.build_cold_heat)
    return scheduler.run(heat.copy(), lambda batch: batch)


def measure_plan_rows(height_um):
    """Return the rows of planning for one height."""
    display, sequence = build_full_frame(height_m=height_um * 1e-6)
    heat, budget = display.build_cold_state()
    planned_sequence = plan_sequence(display, sequence, heat, budget)
    batch = next(schedule_batches(display, sequence, heat))
    count = len(planned_sequence.plan)
    schedule_s = measure_median_cpu_s(lambda: list(schedule_batches(display, sequence, heat)))
    limit_s = measure_median_cpu_s(lambda: limit(batch, budget, display.budget))
    total_s = measure_median_cpu_s(lambda: plan_sequence(display, sequence, heat, budget))
    return [
        (f"{height_um} µm: pulses planned per second", count / schedule_s, "1/s"),
        (f"{height_um} µm: pulses limited per second", count / limit_s, "1/s"),
        (f"{height_um} µm: planned, limited and predicted per second", count / total_s, "1/s"),
        (
            f"{height_um} µm: beam-on fraction of the plan",
            planned_sequence.plan.width_s.sum() / planned_sequence.duration_s,
            "1",
        ),
        (f"{height_um} µm: pixels shown per second of the plan", count / planned_sequence.duration_s, "1/s"),
    ]


def bench_plan():
    """Benchmark planning, limiting and predicting a full 1,511-pixel frame, and the whole command."""
    rows = [row for height_um in (50, 100, 400) for row in measure_plan_rows(height_um)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.json"
        path.write_text(json.dumps({"frames": [{"show_at_s": 0, "duration_s": 10, "target_um": [50.0] * 1511}]}))
        command = [Path(sys.executable).with_name("optodrive"), "plan", path, "--config", "display-1511"]
        cpu_s = statistics.median(measure_child_cpu_s(command) for _ in range(RUNS))
    return [*rows, ("optodrive plan, 1,511 pixels at 50 µm, whole command", cpu_s, "s CPU")]


def bench_wire():
    """Benchmark the encoding of a limited plan, and the verification that decodes it."""
    display, sequence = build_full_frame()
    heat, budget = display.build_cold_state()
    plan = plan_sequence(display, sequence, heat, budget).plan
    scale = build_board_requirements(display.config).scale
    points = quantise(plan, scale)
    payload = points.encode_payload()

    def run_verification():
        decoded = decode(payload, scale)
        verify(plan, points.row[decoded.index], decoded, budget, display.budget)

    return [
        ("pulses quantised per second", len(plan) / measure_median_cpu_s(lambda: quantise(plan, scale)), "1/s"),
        ("pulses decoded and verified per second", len(plan) / measure_median_cpu_s(run_verification), "1/s"),
        ("bytes per pulse", len(payload) / len(plan), "B"),
    ]


def bench_board():
    """Benchmark the board session with the simulated board in virtual time."""
    display, sequence = build_full_frame()
    planned_sequence = plan_sequence(display, sequence, *display.build_cold_state())
    seconds = measure_median_cpu_s(lambda: execute(display, planned_sequence))
    return [
        ("pulses through session and simulated board per second", len(planned_sequence.plan) / seconds, "1/s"),
        ("times real time", planned_sequence.duration_s / seconds, "×"),
    ]


HOUR_S = 3600.0
INTEGRATED_PULSES = 300
"""Pulses for the general integrator, whose time per pulse is constant."""


def build_hour_of_frames():
    """Return the display and the pulse columns of planned full frames at 50 µm, repeated for one hour."""
    display, sequence = build_full_frame()
    planned_sequence = plan_sequence(display, sequence, *display.build_cold_state())
    plan, frames = planned_sequence.plan, int(HOUR_S / planned_sequence.duration_s)
    begin_s = np.repeat(np.arange(frames) * planned_sequence.duration_s, len(plan))
    start_s = np.tile(plan.start_s, frames) + begin_s
    return display, (np.tile(plan.pixel, frames), start_s, np.tile(plan.width_s, frames), np.tile(plan.power_w, frames))


def measure_once_s(work):
    """Return the CPU time of one call, s, and its result."""
    begin_s = time.process_time()
    result = work()
    return time.process_time() - begin_s, result


def integrate_pulses(slope, count, columns):
    """Integrate the pulses with solve_ivp from edge to edge. Return the state [variables × pixels].

    `slope(pixel, light_w)` returns the function dy/dt.
    """
    state, now_s = np.zeros(count), 0.0
    for pixel, start_s, width_s, power_w in zip(*columns, strict=True):
        for light_w, to_s in ((0.0, start_s), (power_w, start_s + width_s)):
            dydt = slope(int(pixel), light_w)
            state = solve_ivp(dydt, (now_s, to_s), state, rtol=1e-8, atol=1e-8).y[:, -1]
            now_s = to_s
    return state


def make_nominal_slope(pixel, count):
    """Return a function that builds dy/dt of nominal pixels."""

    def make_slope(index, light_w):
        def slope(_, state):
            theta, gas = state[:count], state[count:]
            heating = -theta / pixel.tau_s
            heating[index] += pixel.epsilon * light_w / pixel.c_j_per_k
            return np.concatenate([heating, (theta / 2 - gas) / pixel.tau_g_s])

        return slope

    return make_slope


def make_wall_slope(pixel, walls, neighbours):
    """Return a function that builds dy/dt of pixels with walls and neighbours."""

    count, leak = len(neighbours), csr_array(build_conductances_w_per_k(walls, neighbours))

    def make_slope(index, light_w):
        def slope(_, state):
            theta, wall, gas = state[:count], state[count : 2 * count], state[2 * count :]
            flow_w = (theta - wall) / pixel.r_k_per_w
            heating = -flow_w / pixel.c_j_per_k
            heating[index] += pixel.epsilon * light_w / pixel.c_j_per_k
            wall_heating = (flow_w - leak @ wall) / walls.c_j_per_k
            return np.concatenate([heating, wall_heating, ((theta + wall) / 2 - gas) / pixel.tau_g_s])

        return slope

    return make_slope


def measure_hour_rows(name, make_heat, columns, make_slope):
    """Measure one kernel on all pulses, and the general integrator on the first pulses of the same list."""
    first = [column[:INTEGRATED_PULSES] for column in columns]
    reference = make_heat()
    reference.apply_pulses(*first)
    heat = make_heat()
    kernel_s, _ = measure_once_s(lambda: heat.apply_pulses(*columns))
    rises_k = np.concatenate(read_rises_at_end(reference, first))
    solver_s, state = measure_once_s(lambda: integrate_pulses(make_slope, len(rises_k), first))
    kernel_ms, solver_ms = 1e3 * kernel_s / len(columns[0]), 1e3 * solver_s / INTEGRATED_PULSES
    difference_k = np.abs(rises_k - state).max()
    return [
        (f"{name}: one hour, with the peaks of every pulse", kernel_s, "s CPU"),
        (f"{name}: times real time", HOUR_S / kernel_s, "×"),
        (f"{name}: per pulse", kernel_ms, "ms"),
        (f"{name}: per pulse by solve_ivp, rtol 1e-8", solver_ms, "ms"),
        (f"{name}: time of solve_ivp over kernel", solver_ms / kernel_ms, "×"),
        (f"{name}: maximum difference from solve_ivp after {INTEGRATED_PULSES} pulses", difference_k, "K"),
    ]


def read_rises_at_end(heat, columns):
    """Return the temperature rises [p] of each kind at the end of the last pulse."""
    end_s = float(columns[1][-1] + columns[2][-1])
    if isinstance(heat, CoupledDisplay):
        return heat.rises_k(end_s)
    per_pixel = [heat.rises_k(pixel, end_s) for pixel in range(len(heat.pixels))]
    return tuple(np.array(per_pixel).T)


def bench_hour():
    """Benchmark one hour of full frames on 1,511 pixels, nominal and with walls, in one run each."""
    display, columns = build_hour_of_frames()
    pixel, neighbours = display.pixels.elements[0], Neighbours.from_display(display.config.display)
    walls = WallParameters.from_parameters(load_parameters("surroundings"))
    modes_s, modes = measure_once_s(lambda: Modes.diagonalise(pixel, walls, neighbours))
    count = len(display.pixels)
    return [
        ("pulses", len(columns[0]), "1"),
        *measure_hour_rows(
            "nominal", lambda: NominalThermalState(display.pixels), columns, make_nominal_slope(pixel, count)
        ),
        ("walls and neighbours: modes, once per display", modes_s, "s CPU"),
        *measure_hour_rows(
            "walls and neighbours",
            lambda: CoupledDisplay(modes),
            columns,
            make_wall_slope(pixel, walls, neighbours),
        ),
    ]


def read_resident_mib():
    """Return the resident memory of this process, MiB."""
    fields = Path("/proc/self/statm").read_text().split()
    return int(fields[1]) * resource.getpagesize() / 2**20


def bench_limit():
    """Benchmark the limiter alone: a full frame, and 1,000,000 pulses in batches with a continuous budget state."""
    rows = []
    for height_um in (50, 400):
        display, sequence = build_full_frame(height_m=height_um * 1e-6)
        heat, state = display.build_cold_state()
        batch = next(schedule_batches(display, sequence, heat))
        limit_s = measure_median_cpu_s(
            lambda batch=batch, state=state, budget=display.budget: limit(batch, state, budget)
        )
        rows.append((f"{height_um} µm: full frame of 1,511 pulses", 1e3 * limit_s, "ms"))
    display, sequence = build_full_frame()
    heat, state = display.build_cold_state()
    batch = next(schedule_batches(display, sequence, heat))
    period_s = float(batch.start_s[-1] + batch.width_s[-1]) + 1e-3
    samples_mib, count, begin_s = [], 0, time.process_time()
    while count < 1_000_000:
        state = shift_state(limit(batch, state, display.budget)[1], -period_s)
        count += len(batch)
        samples_mib.append(read_resident_mib())
    rows.append(("1,000,000 pulses, frame after frame", time.process_time() - begin_s, "s"))
    rows.append(("memory after 10,000 pulses", samples_mib[7], "MiB"))
    rows.append(("memory after all pulses", samples_mib[-1], "MiB"))
    return rows


DISPLAY_PIXELS, DISPLAY_WORKERS = 100, 2
HIDDEN_TERMS = (
    {"laser_droop": {"share": 0.1, "time": 0.05, "spread": 1.0}},
    {"bridge_conductivity": {"exponent": 0.4}},
    {"gas_leak": {"rate": 4.0}},
    {"heat_capacity": {"slope": 2e-3}},
)
"""Terms hidden on four pixels of ten, one per pixel."""


def bench_display():
    """Benchmark the diagnosis of 100 pixels with 15 runs each on two worker processes, in one run."""
    from display_lab import display_lab
    from optodrive.lab.diagnosis.dask_workers import open_client, run_tasks
    from optodrive.lab.diagnosis.display_diagnosis import PixelTask, compile_kernels, diagnose_pixel
    from optodrive.lab.recording import DisplayRuns, write_recording

    hidden = {
        pixel: HIDDEN_TERMS[pixel % 10] if pixel % 10 < len(HIDDEN_TERMS) else {} for pixel in range(DISPLAY_PIXELS)
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "display.h5"
        write_recording(path, display_lab(hidden, seed=4000))
        file_mib = path.stat().st_size / 2**20
        compile_kernels()
        begin_s = time.monotonic()
        runs = DisplayRuns.open([path])
        opened_s = time.monotonic()
        tasks = [PixelTask(item.pixel, item.read) for item in runs.pixels]
        with open_client(workers=DISPLAY_WORKERS) as client:
            ready_s = time.monotonic()
            answers = {task.pixel: answer for task, answer, _ in run_tasks(client, diagnose_pixel, tasks)}
            end_s = time.monotonic()
            largest_mib = max(client.run(read_peak_mib).values())
    named = [answers[pixel].discrepancy.causes == tuple(terms) for pixel, terms in hidden.items()]
    busy_s = sum(answer.discrepancy.elapsed_s for answer in answers.values())
    return [
        ("pixels, 15 runs per pixel", len(answers), "1"),
        ("size of the recording", file_mib, "MiB"),
        ("correct answers", sum(named), "1"),
        ("whole diagnosis", end_s - begin_s, "s"),
        ("part: opening the recording", opened_s - begin_s, "s"),
        ("part: starting two workers", ready_s - opened_s, "s"),
        ("per pixel, whole diagnosis", (end_s - begin_s) / len(answers), "s"),
        ("per pixel, on its worker", busy_s / len(answers), "s"),
        ("fraction of the workers' time in the diagnosis", busy_s / DISPLAY_WORKERS / (end_s - ready_s), "1"),
        ("maximum memory of a worker", largest_mib, "MiB"),
    ]


def read_peak_mib():
    """Return the peak memory of this process, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def bench_order():
    """Benchmark the scheduler against a solver, which needs the extra `bench`."""
    from bench_order import bench_order as run

    return run()


def bench_page():
    """Benchmark the page in Chromium, which must be installed."""
    from bench_page import bench_page as run

    return run()


BENCHMARKS = {
    "plan": bench_plan,
    "limit": bench_limit,
    "wire": bench_wire,
    "board": bench_board,
    "hour": bench_hour,
    "display": bench_display,
    "field": bench_field,
    "stream": bench_stream,
    "memory": bench_memory,
    "order": bench_order,
    "page": bench_page,
}


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
