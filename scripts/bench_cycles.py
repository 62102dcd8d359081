"""Periodic trains and simultaneous frames: targets, results of an independent integrator, energy.

Every number is a calculation on the shipped display-437; nothing is measured on hardware.
"""

from contextlib import contextmanager
from dataclasses import replace
from itertools import product

import numpy as np
from measuring import build_display, build_frames

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler import scheduler
from optodrive.planning.scheduler.periodic_pulses import limit_pulse_width, solve_steady_state
from reference_models.nominal_pixel import height_um  # of the tests

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
    """Yield the rows of trains by height, and of trains whose pulses are planned from the cold state."""
    name, period_s = f"{count} pixels, {rate_hz} Hz, {target_um} µm", 1.0 / rate_hz
    cold_heat = display.build_cold_heat()
    drive = limit_pulse_width(display.scan_head.drive, compute_beam_time_us(display, count, period_s))
    duration_s = max(SECONDS, CYCLES * period_s)
    first = HeightTrain(PIXELS[0], 0.0, duration_s, period_s, target_um * 1e-6)
    steady = [solve_steady_state(first, cold_heat, drive, n) for n in range(1, drive.max_periods + 1)]
    reaching = [state for state in steady if state.peak_m > 0.9999e-6 * target_um]
    if not reaching:
        yield f"{name}: unreachable, at most", 1e6 * steady[-1].peak_m, "µm"
        return
    max_m, min_m = reaching[0].peak_to_peak_m, steady[-1].peak_to_peak_m
    peak_to_peak_m = min_m + PEAK_TO_PEAK_SHARE * (max_m - min_m)
    trains = tuple(
        replace(first, pixel=PIXELS[k], start_s=round(k * period_s / count, 6), peak_to_peak_m=peak_to_peak_m)
        for k in range(count)
    )
    result = plan_sequence(display, FrameSequence(trains=trains), *display.build_cold_state())
    peak_um, simulated_um, train_j = measure_last_cycles(display, result, trains[0], period_s)
    width_s = result.plan.width_s[result.plan.pixel == PIXELS[0]][-1]
    periods, duty = cold_heat.solve_pulse(PIXELS[0], 0.0, first.target_m, drive, round(width_s / drive.period_s))
    on_s, power_w = periods * drive.period_s, duty * drive.max_power_w
    cold = tuple(PulseTrain(item.pixel, item.start_s, duration_s, on_s, period_s - on_s, power_w) for item in trains)
    cold_result = plan_sequence(display, FrameSequence(trains=cold), *display.build_cold_state())
    cold_um, _, cold_j = measure_last_cycles(display, cold_result, trains[0], period_s)
    yield f"{name}: peak", peak_um, "µm"
    yield f"{name}: error of the peak", 100 * (peak_um / target_um - 1), "%"
    yield f"{name}: peak-to-peak", simulated_um, "µm"
    yield f"{name}: error of peak-to-peak", 100 * (simulated_um / peak_to_peak_m / 1e6 - 1), "%"
    yield f"{name}: energy per cycle", 1e3 * train_j, "mJ"
    yield f"{name}: saved against the cold plan", 100 * (1 - train_j / cold_j), "%"
    trimmed = ", trimmed" if cold_result.plan.trimmed_j.any() else ""
    yield f"{name}: peak of the cold plan{trimmed}", cold_um, "µm"


@contextmanager
def record_candidates():
    """Record the candidate schedules that the scheduler selects from."""
    original, recorded = scheduler.select_schedule, []
    scheduler.select_schedule = lambda items, deadline_s: (recorded.append(items), original(items, deadline_s))[1]
    try:
        yield recorded
    finally:
        scheduler.select_schedule = original


def plan_simultaneously(display, heights_um):
    """Plan a simultaneous frame of heights by pixel, with time for any number of interleaved sub-pulses."""
    target_m = np.zeros(len(display.layout))
    target_m[list(heights_um)] = np.array(list(heights_um.values())) * 1e-6
    (frame,) = build_frames([target_m], 20.0).frames
    sequence = FrameSequence((replace(frame, simultaneous=True),))
    return plan_sequence(display, sequence, *display.build_cold_state())


def measure_rounds(display):
    """Yield simultaneity and duration of squares of pixels by number of interleaved rounds."""
    for side, target_um in ((2, 100), (2, 300), (3, 50), (3, 100), (3, 200), (6, 50)):
        square = [200 + 21 * row + column for row in range(side) for column in range(side)]
        with record_candidates() as recorded:
            (report,) = plan_simultaneously(display, dict.fromkeys(square, target_um)).simultaneous
        for item in recorded[0]:
            selected = ", selected" if item.rounds == report.interleaved_rounds else ""
            name = f"{side * side} simultaneous pixels, {target_um} µm, {item.rounds} rounds{selected}"
            yield f"{name}: simultaneity", item.simultaneity, "1"
            yield f"{name}: end", 1e3 * item.end_s, "ms"
            yield f"{name}: later than with one round", 1e3 * (item.end_s - recorded[0][0].end_s), "ms"


def measure_shortening(display):
    """Yield how many random frames interleaving shortens."""
    generator = np.random.default_rng(1)
    with record_candidates() as recorded:
        for _ in range(FRAMES):
            pixels = generator.choice(len(display.layout), generator.integers(2, 30), replace=False).tolist()
            plan_simultaneously(display, dict(zip(pixels, generator.uniform(5.0, 400.0, len(pixels)), strict=True)))
    longer_s = np.array([item.end_s - items[0].end_s for items in recorded for item in items[1:]])
    name = f"interleaved schedules of {FRAMES} random frames"
    yield name, len(longer_s), "1"
    yield f"{name}: end earlier than with single pulses", np.count_nonzero(longer_s < 0), "1"
    yield f"{name}: minimum added duration", 1e3 * longer_s.min(), "ms"


def measure():
    display = build_display("display-437")
    for count, rate_hz, target_um in product((1, 4), (10, 25, 50), (100, 300)):
        try:
            yield from measure_train(display, count, rate_hz, target_um)
        except InputError as error:
            yield f"{count} pixels, {rate_hz} Hz, {target_um} µm: {error}"
    yield from measure_rounds(display)
    yield from measure_shortening(display)
