"""Plan a sequence without a board: schedule it batch by batch, limit every batch and predict the display's response.

The engine, `optodrive plan` and `optodrive simulate` use this pipeline.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import inf
from typing import TypeGuard

import numpy as np

from optodrive.core.errors import RefusedError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan, PulsePlan
from optodrive.core.types.push_options import Policy
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame, Train
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.batch_limiter import BatchLimiter
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.cap_checks import compute_usage
from optodrive.planning.limiter.limiter import concatenate
from optodrive.planning.limiter.pulse_application import COLD_START
from optodrive.planning.planned_sequence import (
    TIME_TOLERANCE_S,
    Delay,
    FrameTiming,
    PlannedSequence,
    TrainPeaks,
    describe_lateness,
)
from optodrive.planning.scheduler.scheduler import TRAIN_BATCH, Scheduler
from optodrive.planning.scheduler.visiting_path import compile_kernels
from optodrive.planning.sequence_checks import check_targets_reachable, remove_dead_pixels

CONCATENATE_EVERY = 256
"""Number of batches after which they are concatenated: each holds the headroom of every pixel, even for one pulse."""

ROUNDING_S = 1e-6
"""Largest difference of a pulse's start from the exact one: half a microsecond, and rounding errors."""

Progress = Callable[[float], None]
"""Receives the completed fraction, 0 to 1."""


def warm_up(display: DisplayModel) -> None:
    """Plan a sample frame and sample trains, so that every kernel is compiled and loaded."""
    compile_kernels()
    laser, target_m = display.config.laser, np.zeros(len(display.pixels))
    pixel = int(np.argmin(display.dead))
    target_m[pixel] = 1e-6
    # One of each kind: each has kernels of its own, and the first plan of a caller must not compile.
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
    """Plan and limit a whole sequence, as `SequencePlanner` does."""
    planner = SequencePlanner(display, sequence, heat, budget, policy, on_progress, initial_pixels, visiting_orders)
    return planner.plan_until()


class SequencePlanner:
    """Plans and limits a sequence from the given heat and budget, which are on the plan's time line and not changed.

    Under policy "delay", a pulse above a cap is delayed until it fits, together with everything after it: a train pulse
    by itself, a frame as a whole.

    on_progress: receives the completed fraction, 0 to 1; may be replaced between two parts
    display: by whose caps it limits; is_complete: whether all is planned
    initial_pixels: pixel on which each stage's mirrors stand at the plan's start, None while unknown
    visiting_orders: by source, visiting orders that replace the scheduler's own

    Raises InputError for an unreachable height or peak-to-peak value, and for a plan that leads a pixel out of the
    range of a discovered term's data. Raises RefusedError under "refuse" for a pulse above a cap or a missed deadline,
    and under "delay" for a pulse that never fits.
    """

    def __init__(
        self,
        display: DisplayModel,
        sequence: FrameSequence,
        heat: ThermalState,
        budget: BudgetState,
        policy: Policy = "trim",
        on_progress: Progress | None = None,
        initial_pixels: tuple[int, ...] | None = None,
        visiting_orders: Mapping[int, IntArray] | None = None,
    ) -> None:
        self.on_progress = on_progress
        self.is_complete = False
        self.display = display
        # Where a pulse may be refused, in order: here, for a height out of reach or a train on a dead pixel; by a cap,
        # in `max_power_w` of the limiter, which "trim" lowers instead, "delay" moves, and "refuse" raises; for a frame
        # as a whole, in `feasibility/check.py` and `_refuse_late`; for bytes that pass a cap, in
        # `link/proven_points.py`; at the link process, in `_require_allowed` (epoch, pause, arming, damaged bytes); by
        # the session, if it comes too late; by the board's guards B1 to B17.
        self._sequence, self._dead_pixels = remove_dead_pixels(display, sequence)
        self._heat = heat
        self._policy = policy
        self._done = 0.0
        check_targets_reachable(display, self._sequence)
        # As early as possible: the second process compiles while this one plans up to the limiter.
        COLD_START.begin(display.budget, budget)
        self._scheduler = Scheduler(
            display.scan_heads,
            display.build_assignment(self._sequence),
            self._sequence,
            display.build_cold_heat,
            # A delay moves a whole batch: of a train only the pulse that is above a cap.
            train_batch=1 if policy == "delay" else TRAIN_BATCH,
            on_progress=self._report_progress,
            initial_pixels=initial_pixels,
            visiting_orders=visiting_orders,
        )
        frame_count = len(self._sequence.frames)
        self._limiter = BatchLimiter(self._scheduler, display.budget, budget, frame_count, policy)
        # A generator: plan_until stops between two batches and goes on later, with scheduler and limiter as they stand.
        self._batches = self._scheduler.run(heat.copy(), self._limiter.grant)
        self._limited: list[LimitedPlan] = []
        self._recent: list[LimitedPlan] = []

    def plan_until(self, until_s: float = inf) -> PlannedSequence:
        """Go on to the first pulse that ends at this time of the plan or later, and return the plan so far.

        Later calls add rows and change none. Parts and whole have the same pulses where the heat of a pixel does not
        depend on its neighbours'.
        """
        self._scheduler.until_us = until_s * 1e6
        self.is_complete = True
        for batch in self._batches:
            self._recent.append(batch)
            if len(self._recent) == CONCATENATE_EVERY:
                self._limited.append(self._concatenate(self._recent))
                self._recent = []
            self._done = _compute_progress(self._sequence, batch)
            self._report_progress()
            if batch.end_s >= until_s:
                self.is_complete = False
                break
        planned = self._build_planned(self._concatenate([*self._limited, *self._recent]))
        if self._policy == "refuse":
            _refuse_late(planned)
        return planned

    def _build_planned(self, plan: LimitedPlan) -> PlannedSequence:
        self._report_progress()
        # Predicted anew from before the plan: the scheduler's heat applied batches, this one applies the plan as a
        # whole.
        heat, lead_in_s = self._heat.copy(), self._scheduler.lead_in_us * 1e-6
        peaks = heat.apply_pulses(plan.pixel, plan.start_s, plan.width_s, plan.power_w, self._report_progress)
        heat.check_tested()
        return PlannedSequence(
            sequence=self._sequence,
            plan=plan,
            predicted_m=peaks.displacement_m,
            lead_in_s=lead_in_s,
            skipped=tuple(self._scheduler.skipped),
            frames=_compute_frame_timings(self._sequence, plan, lead_in_s, self._report_progress),
            simultaneous=tuple(self._scheduler.simultaneous),
            train_peaks=_compute_train_peaks(self._sequence, plan, self._heat.copy(), lead_in_s, self._report_progress),
            shortfall=self._limiter.build_shortfall(),
            delays=_merge_delays(self._limiter.delays),
            galvo_pause_s=self._limiter.galvo_pause_s,
            early_step_s=1e-6 * self.display.scan_head.settling.early_us,
            heat=heat,
            budget=self._limiter.state,
            dead_pixels=self._dead_pixels,
        )

    def _concatenate(self, batches: list[LimitedPlan]) -> LimitedPlan:
        return concatenate(batches, self._limiter.state, self.display.budget)

    def _report_progress(self) -> None:
        if self.on_progress is not None:
            self.on_progress(self._done)


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


def _compute_train_peaks(
    sequence: FrameSequence,
    plan: LimitedPlan,
    heat: ThermalState,
    lead_in_s: float,
    on_progress: Callable[[], None],
) -> tuple[TrainPeaks, ...]:
    """Compute the peaks of all cycles of the trains by height. Changes `heat`, which is that before the plan."""
    sources = range(len(sequence.frames), len(sequence.frames) + len(sequence.trains))
    trains = {source: train for source, train in zip(sources, sequence.trains, strict=True) if _is_by_height(train)}
    if not trains:
        return ()
    edges_s = {source: _find_cycle_edges_s(source, train, plan, lead_in_s) for source, train in trains.items()}
    # A pulse's peak counts until the next pulse on its pixel. Dark pulses at the edges of the cycles separate them.
    is_one_beam = not plan.stage.any()
    edge_s = np.concatenate(
        [
            _move_behind_pulses(edges_s[source], plan, is_one_beam | (plan.pixel == train.pixel))
            for source, train in trains.items()
        ]
    )
    edge_pixel = np.repeat([train.pixel for train in trains.values()], [len(each) for each in edges_s.values()])
    pixel, dark = np.append(edge_pixel, plan.pixel), np.zeros(len(edge_s))
    # Edges first: with the stable sort a dark pulse at a pulse's start comes before it and ends the former cycle.
    start_s = np.append(edge_s, plan.start_s)
    order = np.argsort(start_s, kind="stable")
    pixel, start_s = pixel[order], start_s[order]
    width_s, power_w = np.append(dark, plan.width_s)[order], np.append(dark, plan.power_w)[order]
    peak_m = heat.apply_pulses(pixel, start_s, width_s, power_w, on_progress).displacement_m
    result = []
    for source, train in trains.items():
        on_progress()
        rows = np.flatnonzero(pixel == train.pixel)
        cycle = np.searchsorted(edges_s[source] - ROUNDING_S, start_s[rows], side="right") - 1
        is_inside = (cycle >= 0) & (cycle < len(edges_s[source]) - 1)
        train_peak_m = np.zeros(len(edges_s[source]) - 1)
        np.maximum.at(train_peak_m, cycle[is_inside], peak_m[rows[is_inside]])
        result.append(TrainPeaks(source, train.pixel, train.target_m, train_peak_m))
    return tuple(result)


def _is_by_height(train: Train) -> TypeGuard[HeightTrain]:
    return isinstance(train, HeightTrain)


def _find_cycle_edges_s(source: int, train: HeightTrain, plan: LimitedPlan, lead_in_s: float) -> FloatArray:
    """Return the starts of a train's cycles as planned, and the end of the last one, [c + 1]."""
    starts_s = train.pulse_starts_s()
    edges_s = lead_in_s + np.append(starts_s, starts_s[-1] + train.period_s)
    rows = np.flatnonzero(plan.source == source)[::-1]  # of the rows of a cycle, the first one is assigned last
    cycle = np.searchsorted(edges_s[:-1] - ROUNDING_S, plan.requested_start_s[rows], side="right") - 1
    late_s = np.full(len(edges_s), np.nan)
    late_s[cycle] = plan.start_s[rows] - edges_s[cycle]
    known = np.flatnonzero(np.isfinite(late_s))
    if len(known):  # a cycle without a pulse is as late as the one before it
        before = np.searchsorted(known, np.arange(len(late_s)), side="right") - 1
        edges_s = edges_s + late_s[known[np.maximum(before, 0)]]
        edges_s[cycle] = plan.start_s[rows]
    return np.asarray(np.minimum.accumulate(edges_s[::-1])[::-1], dtype=np.float64)


def _move_behind_pulses(edges_s: FloatArray, plan: LimitedPlan, rows: BoolArray) -> FloatArray:
    """Move times that fall into a pulse of some rows to its end: heat cannot be asked about the time before that."""
    start_s, end_s = plan.start_s[rows], (plan.start_s + plan.width_s)[rows]
    ends_s = np.maximum.accumulate(np.append(-inf, end_s))
    behind_s = np.maximum(edges_s, ends_s[np.searchsorted(start_s, edges_s, side="right")])
    next_s = np.append(start_s, inf)[np.searchsorted(start_s, behind_s - TIME_TOLERANCE_S)]
    # Of pulses that abut, the later may begin before the end by rounding.
    return np.asarray(np.minimum(behind_s, next_s), dtype=np.float64)


def _refuse_late(planned: PlannedSequence) -> None:
    for timing in planned.frames:
        if timing.late_s > 0:
            raise RefusedError(describe_lateness(timing))
