"""The scheduler: its order, a naive order, a solver's order, and the lower bound set by the optics.

Every order starts cold and uses the same pulse rule: each pulse is the shortest that reaches its target from the
residual heat at its start. The naive order visits the pixels row by row; each of its moves takes 0.4 ms plus the
distance at the slew rate. The solver is LKH (elkai), with the settling times of the scheduler. The lower bound is
beam-on time alone: the same pulses without moves and at full power, so without rounding to whole PWM periods.
"""

import time

import elkai
import numpy as np
from measuring import build_display, build_frames
from trajectory_rows import measure_trajectories

from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler.visiting_path import compute_visiting_order
from optodrive.planning.stimuli.pattern_registry import build_pattern

NAIVE_SETTLE_S = 4e-4
LKH_RUNS = 10
LONG_DWELL_US = 1_000_000
"""Dwell after which every move has the settling time of a long dwell, µs."""
EXPERIMENTS = tuple(f"experiment-{k}" for k in range(1, 7))


class OrderBenchmark:
    """A cold display with its scan head and settling times."""

    def __init__(self, name):
        self.display = build_display(name)
        scan_head = self.display.scan_head
        self.layout, self.settling, self.drive = scan_head.layout, scan_head.settling, scan_head.drive
        self.x_rad, self.y_rad = scan_head.field.angles_rad(self.layout.x_m, self.layout.y_m)

    def compute_move_us(self, origin, pixel, dwell_us=LONG_DWELL_US):
        """Return the settling time of a move, µs, or the lead-in without an origin."""
        if origin is None:
            return self.settling.lead_in_us
        return self.settling.settling_us(
            self.x_rad[pixel] - self.x_rad[origin], self.y_rad[pixel] - self.y_rad[origin], dwell_us
        )

    def compute_naive_move_us(self, origin, pixel, _dwell_us=0):
        """Return the naive duration of a move, µs, or the lead-in without an origin."""
        if origin is None:
            return self.settling.lead_in_us
        distance_rad = max(abs(self.x_rad[pixel] - self.x_rad[origin]), abs(self.y_rad[pixel] - self.y_rad[origin]))
        return 1e6 * (NAIVE_SETTLE_S + distance_rad / self.display.config.scanner.slew_rad_per_s)

    def order_by_row(self, active, _origin):
        """Return the pixels row by row."""
        return active

    def order_by_scheduler(self, active, origin):
        """Return the pixels in the order of the scheduler."""
        return compute_visiting_order(active, self.layout.row, self.layout.column, self.x_rad, self.y_rad, origin)

    def order_by_solver(self, active, origin):
        """Return the shortest open path that LKH finds for the settling times, from `origin` if there is one."""
        if len(active) < 3:
            return active
        nodes = active if origin is None else np.concatenate([[origin], active])
        durations = [[self.compute_move_us(a, b) for b in nodes.tolist()] for a in nodes.tolist()]
        # A dummy node at zero distance closes the open path; with an origin, only the origin may follow the dummy.
        forbidden = 10 * max(map(max, durations)) * len(nodes)
        matrix = [[0] * (len(nodes) + 1)]
        for k, row in enumerate(durations):
            matrix.append([0 if origin is None or k else forbidden, *row])
        if origin is not None:
            matrix[0][2:] = [forbidden] * (len(nodes) - 1)
            for row in matrix[2:]:
                row[0] = 0
            matrix[1][0] = forbidden
        tour = elkai.DistanceMatrix(matrix).solve_tsp(runs=LKH_RUNS)[:-1]
        begin = tour.index(0)
        path = nodes[np.array(tour[begin + 1 :] + tour[:begin]) - 1]
        return path if origin is None else path[1:]

    def plan_order(self, frames, order_of, move_us):
        """Return the total time, the beam-on time as sent and at full power, s, and the pulse count."""
        heat = self.display.build_cold_heat()
        now_us, pixel_before, dwell_us = 0, None, LONG_DWELL_US
        light_us, full_power_us, count = 0, 0.0, 0
        for target_m in frames:
            for pixel in order_of(np.flatnonzero(target_m > 0), pixel_before).tolist():
                move = move_us(pixel_before, pixel, dwell_us)
                pulse = heat.solve_pulse(pixel, (now_us + move) * 1e-6, float(target_m[pixel]), self.drive)
                if pulse is None:
                    continue
                width_us = round(pulse[0] * self.drive.period_s * 1e6)
                power_w = pulse[1] * self.drive.max_power_w
                start_s = np.array([(now_us + move) * 1e-6])
                heat.apply_pulses(np.array([pixel]), start_s, np.array([width_us * 1e-6]), np.array([power_w]))
                now_us += move + width_us
                light_us, count = light_us + width_us, count + 1
                full_power_us += pulse[0] * pulse[1] * self.drive.period_s * 1e6  # the duty holds in every period
                pixel_before, dwell_us = pixel, width_us
        return {
            "total_s": now_us * 1e-6,
            "light_s": light_us * 1e-6,
            "full_power_s": full_power_us * 1e-6,
            "count": count,
        }


def build_cases(bench):
    """Yield the name of each case and its frames, targets [p] in m, shown one after the other."""
    layout, count = bench.layout, len(bench.layout)
    rng = np.random.default_rng(11)

    def build_target(pixels, height_m=50e-6):
        target_m = np.zeros(count)
        target_m[pixels] = height_m
        return target_m

    yield from ((f"full, {height} µm", [np.full(count, height * 1e-6)]) for height in (50, 100, 400))
    yield from ((f"{n} at random, 50 µm", [build_target(rng.choice(count, n, replace=False))]) for n in (10, 50, 200))
    yield "diagonal band, 50 µm", [build_target(np.flatnonzero(np.abs(layout.row - layout.column) < 2))]
    corners = [(5, 5), (8, 30), (30, 12), (33, 33), (20, 20)]
    near = [(np.abs(layout.row - r) < 3) & (np.abs(layout.column - c) < 3) for r, c in corners]
    yield "five clusters, 50 µm", [build_target(np.flatnonzero(np.any(near, axis=0)))]
    for name, pattern, given in (("moving edge", "edge", {}), ("braille, optodrive", "text", {"text": "optodrive"})):
        sequence = build_pattern(pattern, given, bench.display.config)
        yield name, [frame.target_m for frame in sequence.frames]


def measure_case(bench, name, frames):
    """Yield the rows of one case."""
    begin_s = time.process_time()
    solver = bench.plan_order(frames, bench.order_by_solver, bench.compute_move_us)
    solver_s = time.process_time() - begin_s
    ours = bench.plan_order(frames, bench.order_by_scheduler, bench.compute_move_us)
    naive = bench.plan_order(frames, bench.order_by_row, bench.compute_naive_move_us)
    floor_s = bench.plan_order(frames, bench.order_by_scheduler, lambda *_: 0)["full_power_s"]
    yield f"{name}: pixels shown", ours["count"], "1"
    for who, result in (("naive", naive), ("solver", solver), ("scheduler", ours)):
        yield f"{name}: pixels per second, {who}", result["count"] / result["total_s"], "1/s"
        yield f"{name}: beam-on fraction, {who}", result["light_s"] / result["total_s"], "1"
        yield f"{name}: time over lower bound, {who}", result["total_s"] / floor_s, "×"
    yield f"{name}: scheduler over solver", ours["total_s"] / solver["total_s"], "×"
    excess_s = ours["total_s"] - floor_s
    for part, part_s in (
        ("moves", ours["total_s"] - ours["light_s"]),
        ("whole PWM periods", ours["light_s"] - ours["full_power_s"]),
        ("heat lost meanwhile", ours["full_power_s"] - floor_s),
    ):
        yield f"{name}: excess over lower bound, fraction by {part}", part_s / excess_s, "1"
    yield f"{name}: CPU time of the solver", solver_s, "s CPU"
    if len(frames) == 1:
        planned = plan_sequence(bench.display, build_frames(frames, 3600.0), *bench.display.build_cold_state())
        is_same = abs(planned.duration_s - ours["total_s"]) < 1e-6 or planned.shortfall is not None
        assert is_same, "the order differs from the plan"


def measure_experiment(bench, name):
    """Measure an experiment: its stimulus fixes the order, and the moves determine the lateness."""
    sequence = build_pattern(name, {}, bench.display.config)
    planned_sequence = plan_sequence(bench.display, sequence, *bench.display.build_cold_state())
    plan = planned_sequence.plan
    light_s = float(plan.width_s.sum())
    free_us, pixel_before, late_us = 0.0, None, 0.0
    for pixel, requested_s, width_s in zip(plan.pixel.tolist(), plan.requested_start_s, plan.width_s, strict=True):
        move_us = 0.0 if pixel == pixel_before else bench.compute_naive_move_us(pixel_before, pixel)
        start_us = max(1e6 * requested_s, free_us + move_us)
        late_us = max(late_us, start_us - 1e6 * requested_s)
        free_us, pixel_before = start_us + 1e6 * width_s, pixel
    yield f"{name}: pulses per second", len(plan) / planned_sequence.duration_s, "1/s"
    yield f"{name}: beam-on fraction", light_s / planned_sequence.duration_s, "1"
    yield f"{name}: time over beam-on time, naive", 1e-6 * free_us / light_s, "×"
    yield f"{name}: time over beam-on time, scheduler", planned_sequence.duration_s / light_s, "×"
    yield f"{name}: maximum lateness of a pulse, naive", 1e-3 * late_us, "ms"
    yield f"{name}: maximum lateness of a pulse, scheduler", 1e3 * planned_sequence.train_lateness_max_s, "ms"


def measure():
    bench = OrderBenchmark("display-1511")
    for name, frames in build_cases(bench):
        yield from measure_case(bench, name, frames)
    yield from measure_trajectories(bench)
    perceived = OrderBenchmark("display-437")
    for name in EXPERIMENTS:
        yield from measure_experiment(perceived, name)
