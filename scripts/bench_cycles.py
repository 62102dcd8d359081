"""Benchmark of periodic trains and simultaneous frames: targets, results of an independent integrator, energy.

Every number is a calculation on the shipped display-437; nothing is measured on hardware.
"""

import sys
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler import scheduler
from optodrive.planning.scheduler.periodic_pulses import limit_pulse_width, solve_steady_state

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from reference_models.nominal_pixel import height_um

PIXELS = (200, 201, 222, 221)
SECONDS, CYCLES = 0.6, 12
"""Duration of a train, s, and its minimum number of cycles."""
STEADY_CYCLES = 5
"""Cycles at the end of a train that are evaluated."""
FRAMES = 300
PEAK_TO_PEAK_SHARE = 0.5
"""Requested peak-to-peak between the minimum (0) and the maximum (1) that a height and a rate allow."""


def measure_last_cycles(display, result, train, period_s):
    """Return the mean peak and peak-to-peak of a train's last cycles, µm, and its energy per cycle, J."""
    plan = result.plan
    rows = np.flatnonzero(plan.pixel == train.pixel)
    starts_s = train.pulse_starts_s()[-STEADY_CYCLES - 1 : -1] + result.lead_in_s
    t_s = np.linspace(starts_s[0], starts_s[0] + STEADY_CYCLES * period_s, 200 * STEADY_CYCLES + 1)
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w])[rows]
    cycles_um = height_um(display.pixels.elements[train.pixel], pulses, t_s)[:-1].reshape(STEADY_CYCLES, 200)
    row_numbers = rows[(plan.start_s[rows] > starts_s[0] - 1e-6) & (plan.start_s[rows] < t_s[-1] - 1e-6)]
    return (
        cycles_um.max(axis=1).mean(),
        np.ptp(cycles_um, axis=1).mean(),
        plan.energy_j[row_numbers].sum() / STEADY_CYCLES,
    )


def compute_beam_time_us(display, count, period_s):
    """Return the beam time per pulse of one of `count` trains that share a period, µs."""
    scan_head = display.scan_head
    period_share_us = round((period_s - scan_head.pulse_gap_s) * 1e6)
    if count == 1:
        return period_share_us
    x_rad, _ = scan_head.field.angles_rad(display.layout.x_m, display.layout.y_m)
    return min(
        period_share_us, int(1e6 * period_s / count) - scan_head.settling.settling_us(x_rad[201] - x_rad[200], 0.0)
    )


def measure_train(display, count, rate_hz, target_um):
    """Return one row of the table of cycles."""
    period_s = 1.0 / rate_hz
    cold_heat, drive = (
        display.build_cold_heat(),
        limit_pulse_width(display.scan_head.drive, compute_beam_time_us(display, count, period_s)),
    )
    duration_s = max(SECONDS, CYCLES * period_s)
    first = HeightTrain(PIXELS[0], 0.0, duration_s, period_s, target_um * 1e-6)
    row_start = (str(count), f"{rate_hz:g}", f"{target_um:g}")
    min_periods = next(
        (
            n
            for n in range(1, drive.max_periods + 1)
            if solve_steady_state(first, cold_heat, drive, n).peak_m > 0.9999e-6 * target_um
        ),
        None,
    )
    if min_periods is None:
        return (
            *row_start,
            f"unreachable: max {1e6 * solve_steady_state(first, cold_heat, drive, drive.max_periods).peak_m:.0f}",
        )
    peak_to_peak_max_m, peak_to_peak_min_m = (
        solve_steady_state(first, cold_heat, drive, n).peak_to_peak_m for n in (min_periods, drive.max_periods)
    )
    peak_to_peak_m = peak_to_peak_min_m + PEAK_TO_PEAK_SHARE * (peak_to_peak_max_m - peak_to_peak_min_m)
    trains = tuple(
        replace(first, pixel=PIXELS[k], start_s=round(k * period_s / count, 6), peak_to_peak_m=peak_to_peak_m)
        for k in range(count)
    )
    result = plan_sequence(display, FrameSequence(trains=trains), *display.build_cold_state())
    peak_um, simulated_peak_to_peak_um, train_j = measure_last_cycles(display, result, trains[0], period_s)
    width_s = result.plan.width_s[result.plan.pixel == PIXELS[0]][-1]
    periods, duty = cold_heat.solve_pulse(PIXELS[0], 0.0, first.target_m, drive, round(width_s / drive.period_s))
    cold = tuple(
        PulseTrain(
            item.pixel, item.start_s, duration_s, periods * drive.period_s,
            period_s - periods * drive.period_s, duty * drive.max_power_w,
        )
        for item in trains
    )  # fmt: skip
    cold_result = plan_sequence(display, FrameSequence(trains=cold), *display.build_cold_state())
    cold_um, _, cold_j = measure_last_cycles(display, cold_result, trains[0], period_s)
    trimmed = "" if not cold_result.plan.trimmed_j.any() else ", trimmed"
    return (
        *row_start,
        f"{peak_um:.1f} ({100 * (peak_um / target_um - 1):+.2f} %)",
        f"{1e6 * peak_to_peak_m:.1f}",
        f"{simulated_peak_to_peak_um:.1f} ({100 * (simulated_peak_to_peak_um / peak_to_peak_m / 1e6 - 1):+.1f} %)",
        f"{1e3 * train_j:.2f}",
        f"{1e3 * cold_j:.2f}",
        f"{100 * (1 - train_j / cold_j):.0f} %",
        f"{cold_um:.0f}{trimmed}",
    )


def build_cycles_table(display):
    """Compare trains by height with trains whose pulses are planned from the cold state."""
    columns = ("pixels", "Hz", "peak µm", "simulated", "peak-to-peak µm", "simulated")
    energy_columns = ("mJ/cycle", "cold plan", "saved", "peak of cold plan")
    table = Table(*columns, *energy_columns, title="trains by height")
    for count, rate_hz, target_um in product((1, 4), (10, 25, 50), (100, 300)):
        try:
            table.add_row(*measure_train(display, count, rate_hz, target_um))
        except InputError as error:
            table.add_row(str(count), f"{rate_hz:g}", f"{target_um:g}", str(error))
    return table


@contextmanager
def record_candidates():
    """Record the candidate schedules that the scheduler selects from."""
    original, recorded = scheduler.select_schedule, []
    scheduler.select_schedule = lambda items, deadline_s: (recorded.append(items), original(items, deadline_s))[1]
    try:
        yield recorded
    finally:
        scheduler.select_schedule = original


def plan_frame(display, heights_um):
    """Plan a simultaneous frame of heights by pixel, with time for any number of interleaved sub-pulses."""
    target_m = np.zeros(len(display.layout))
    target_m[list(heights_um)] = np.array(list(heights_um.values())) * 1e-6
    frame = TactileFrame("f", 0.0, 20.0, target_m, simultaneous=True)
    return plan_sequence(display, FrameSequence((frame,)), *display.build_cold_state())


def build_simultaneous_table(display):
    """Return simultaneity and duration of squares of pixels by number of interleaved rounds."""
    table = Table("pixels", "µm", "rounds", "simultaneity", "end ms", "added ms", "", title="simultaneous frames")
    for side, target_um in ((2, 100), (2, 300), (3, 50), (3, 100), (3, 200), (6, 50)):
        square = [200 + 21 * row + column for row in range(side) for column in range(side)]
        with record_candidates() as recorded:
            (report,) = plan_frame(display, dict.fromkeys(square, target_um)).simultaneous
        for item in recorded[0]:
            longer_ms = 1e3 * (item.end_s - recorded[0][0].end_s)
            table.add_row(
                f"{side * side}",
                f"{target_um}",
                f"{item.rounds}",
                f"{item.simultaneity:.3f}",
                f"{1e3 * item.end_s:.1f}",
                f"{longer_ms:+.1f}",
                "selected" if item.rounds == report.interleaved_rounds else "",
            )
    return table


def measure_shortening(display):
    """Count the random frames that interleaving shortens. Return one line."""
    generator = np.random.default_rng(1)
    with record_candidates() as recorded:
        for _ in range(FRAMES):
            pixels = generator.choice(len(display.layout), generator.integers(2, 30), replace=False)
            plan_frame(display, dict(zip(pixels.tolist(), generator.uniform(5.0, 400.0, len(pixels)), strict=True)))
    longer_s = np.array([item.end_s - items[0].end_s for items in recorded for item in items[1:]])
    return (
        f"{FRAMES} random frames, {len(longer_s)} interleaved schedules: {np.count_nonzero(longer_s < 0)} end earlier "
        f"than a single pulse per pixel, minimum added duration {1e3 * longer_s.min():.1f} ms"
    )


def main() -> int:
    display, console = DisplayModel.from_config(load_config("display-437")), Console(width=150)
    console.print(build_cycles_table(display))
    console.print(build_simultaneous_table(display))
    console.print(measure_shortening(display))
    return 0


if __name__ == "__main__":
    sys.exit(main())
