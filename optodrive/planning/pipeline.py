"""Plan a sequence without a board: schedule it batch by batch, limit every batch and predict the display's response.

The engine, `optodrive plan` and `optodrive simulate` use this pipeline.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from optodrive.core.errors import RefusedError
from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan, PulsePlan
from optodrive.core.types.push_options import Policy
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.batch_limiter import BatchLimiter
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.cold_start import COLD_START
from optodrive.planning.limiter.limiter import concatenate
from optodrive.planning.limiter.usage import compute_usage
from optodrive.planning.planned_sequence import (
    TIME_TOLERANCE_S,
    Delay,
    FrameTiming,
    PlannedSequence,
    describe_lateness,
)
from optodrive.planning.scheduler.scheduler import TRAIN_BATCH, Scheduler
from optodrive.planning.scheduler.visiting_path import compile_kernels
from optodrive.planning.sequence_checks import check_targets_reachable, remove_dead_pixels

CONCATENATE_EVERY = 256
"""Number of batches after which they are concatenated: each holds the headroom of every pixel, even for one pulse."""

Progress = Callable[[float], None]
"""Receives the completed fraction, 0 to 1."""


def warm_up(display: DisplayModel) -> None:
    """Plan a sample frame and sample trains, so that every kernel is compiled and loaded."""
    compile_kernels()
    laser, target_m = display.config.laser, np.zeros(len(display.pixels))
    pixel = int(np.argmin(display.dead))
    target_m[pixel] = 1e-6
    trains = (
        PulseTrain(pixel, 1.0, 1e-3, 1.0 / laser.pwm_hz, 1e-3, laser.max_power_w),
        HeightTrain(pixel, 2.0, 1e-3, 0.1, 1e-6),
    )
    frames = tuple(TactileFrame("", at_s, 1.0, target_m) for at_s in (0.0, 1.0))
    for each in (FrameSequence(frames), FrameSequence(frames, trains)):  # a frame alone takes a kernel of its own
        plan_sequence(display, each, *display.build_cold_state())
    if not display.parameters.planner_terms:
        # The feasibility check simulates traces.
        display.build_cold_heat().simulate_traces(np.zeros((0, 4)), [0], np.zeros(2))
    # The telemetry reads heat and budget while a plan runs.
    display.build_cold_heat().state_at(0.0)
    compute_usage(display.build_cold_state()[1], display.budget, 0.0)


def plan_sequence(
    display: DisplayModel,
    sequence: FrameSequence,
    heat: ThermalState,
    budget: BudgetState,
    policy: Policy = "trim",
    on_progress: Progress | None = None,
    initial_pixels: tuple[int, ...] | None = None,
    visiting_orders: Mapping[int, IntArray] | None = None,
) -> PlannedSequence:
    """Plan and limit a sequence from the given heat and budget, which are on the plan's time line and not changed.

    Under policy "delay", a pulse above a cap is delayed until it fits, together with everything after it: a train pulse
    by itself, a frame as a whole.

    initial_pixels: pixel on which each stage's mirrors stand at the plan's start, None while unknown
    visiting_orders: by source, visiting orders that replace the scheduler's own

    Raises InputError for an unreachable height or peak-to-peak value. Raises RefusedError under "refuse" for a pulse
    above a cap or a missed deadline, and under "delay" for a pulse that never fits.
    """
    sequence, dead_pixels = remove_dead_pixels(display, sequence)
    check_targets_reachable(display, sequence)
    done = 0.0

    def report_progress() -> None:
        if on_progress is not None:
            on_progress(done)

    COLD_START.begin(display.budget, budget)
    scheduler = Scheduler(
        display.scan_heads,
        display.build_assignment(sequence),
        sequence,
        display.build_cold_heat,
        train_batch=1 if policy == "delay" else TRAIN_BATCH,
        on_progress=report_progress,
        initial_pixels=initial_pixels,
        visiting_orders=visiting_orders,
    )
    limiter = BatchLimiter(scheduler, display.budget, budget, len(sequence.frames), policy)
    limited: list[LimitedPlan] = []
    recent: list[LimitedPlan] = []
    for batch in scheduler.run(heat.copy(), limiter.grant):
        recent.append(batch)
        if len(recent) == CONCATENATE_EVERY:
            limited, recent = [*limited, concatenate(recent, limiter.state, display.budget)], []
        done = _compute_progress(sequence, batch)
        report_progress()
    plan = concatenate([*limited, *recent], limiter.state, display.budget)
    report_progress()
    final_heat = heat.copy()
    peaks = final_heat.apply_pulses(plan.pixel, plan.start_s, plan.width_s, plan.power_w, report_progress)
    lead_in_s = scheduler.lead_in_us * 1e-6
    planned = PlannedSequence(
        sequence=sequence,
        plan=plan,
        predicted_m=peaks.displacement_m,
        lead_in_s=lead_in_s,
        skipped=tuple(scheduler.skipped),
        frames=_compute_frame_timings(sequence, plan, lead_in_s, report_progress),
        simultaneous=tuple(scheduler.simultaneous),
        shortfall=limiter.build_shortfall(),
        delays=_merge_delays(limiter.delays),
        galvo_pause_s=limiter.galvo_pause_s,
        heat=final_heat,
        budget=limiter.state,
        dead_pixels=dead_pixels,
    )
    if policy == "refuse":
        _refuse_late(planned)
    return planned


def _merge_delays(delays: list[Delay]) -> tuple[Delay, ...]:
    """Sum the delays of each source and cap, in the order of their first delay."""
    by_source_and_cap: dict[tuple[int, str], Delay] = {}
    for delay in delays:
        key = delay.source, delay.cap
        before = by_source_and_cap.get(key, replace(delay, wait_s=0.0))
        by_source_and_cap[key] = replace(before, wait_s=before.wait_s + delay.wait_s)
    return tuple(by_source_and_cap.values())


def _compute_progress(sequence: FrameSequence, batch: PulsePlan) -> float:
    ends = [f.show_at_s + f.duration_s for f in sequence.frames] + [t.start_s + t.duration_s for t in sequence.trains]
    return min(1.0, float(batch.requested_start_s[-1]) / max(ends))


def _compute_frame_timings(
    sequence: FrameSequence, plan: LimitedPlan, lead_in_s: float, on_progress: Callable[[], None]
) -> tuple[FrameTiming, ...]:
    timings = []
    end_s = plan.start_s + plan.width_s
    for source, frame in enumerate(sequence.frames):
        on_progress()
        rows = np.flatnonzero(plan.source == source)
        if not len(rows):
            continue
        deadline_s = lead_in_s + frame.show_at_s + frame.duration_s
        timings.append(
            FrameTiming(
                source=source,
                frame_id=frame.frame_id,
                show_at_s=lead_in_s + frame.show_at_s,
                deadline_s=deadline_s,
                first_pulse_s=float(plan.start_s[rows[0]]),
                end_s=float(end_s[rows].max()),
                pulses=len(rows),
                on_time=int(np.count_nonzero(end_s[rows] <= deadline_s + TIME_TOLERANCE_S)),
            )
        )
    return tuple(timings)


def _refuse_late(planned: PlannedSequence) -> None:
    for timing in planned.frames:
        if timing.late_s > 0:
            raise RefusedError(describe_lateness(timing))
