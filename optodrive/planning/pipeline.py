"""Sequence to limited plan, without a board: schedule a piece, limit it, let the heat follow, predict.

The engine, `optodrive plan` and `optodrive simulate` all come through here.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil, inf

import numpy as np

from optodrive.core.errors import InputError, OverBudgetError, RefusedError
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan, PulsePlan
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.core.units import ZERO_CELSIUS_K, m_to_um
from optodrive.device.config import Config, PixelLayout, build_pixel_layout
from optodrive.device.field_loader import build_settling_table, load_scan_field
from optodrive.device.pixel_map import build_aim_layout, load_pixel_map
from optodrive.physics.parameters import ParameterSet, PixelArray, build_display_pixels, load_parameters
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import ThermalState, build_cold_state
from optodrive.planning.budget_setup import build_budget
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import (
    Policy,
    cold_state,
    compute_wait_s,
    concatenate,
    galvo_feasible_prefix,
    limit,
)
from optodrive.planning.limiter.usage import compute_usage
from optodrive.planning.scheduler.interleaving import SimultaneousFrame
from optodrive.planning.scheduler.scheduler import TRAIN_BATCH, GalvoPause, ScanHead, Scheduler, SkippedPulse
from optodrive.planning.scheduler.visiting_path import compile_kernels as warm_order

CONCATENATE_EVERY = 256
"""Pieces joined at a time: each carries the headroom of every pixel, and a piece may be a single pulse."""

PAUSE_FRACTION = 0.1
"""Mirrors rest for this share of the time over which their coils' heat is averaged."""
COLD_AFTER_AVERAGING_TIMES = 50.0

Progress = Callable[[float], None]
"""Told the share done, 0 to 1."""
TIME_TOLERANCE_S = 1e-9
"""Times are whole microseconds; sums of them may be off by this much."""


@dataclass(frozen=True, eq=False)
class DisplayModel:
    """A configuration resolved into what the stages take.

    layout: where pixels lie; the machine's says where the beam is sent for them. dead: [p] which are known to be dead
    """

    config: Config
    layout: PixelLayout
    parameters: ParameterSet
    pixels: PixelArray
    dead: BoolArray
    scan_head: ScanHead
    budget: Budget

    @classmethod
    def from_config(cls, config: Config) -> "DisplayModel":
        """Resolve a configuration."""
        layout, pixel_map = build_pixel_layout(config.display), load_pixel_map(config)
        parameters = load_parameters(config.pixel_model.parameters)
        pixels = build_display_pixels(config, parameters)
        limits, laser = config.limits, config.laser
        scan_head = ScanHead(
            layout=build_aim_layout(config),
            field=load_scan_field(config),
            settling=build_settling_table(config),
            drive=DriveRange.from_laser(laser.max_power_w, laser.pwm_hz, limits.pulse_width_max_s),
            pulse_rest_s=limits.pulse_gap_min_s,
        )
        dead = np.zeros(len(layout), dtype=np.bool_) if pixel_map is None else pixel_map.dead
        return cls(config, layout, parameters, pixels, dead, scan_head, build_budget(config, parameters, pixels))

    @property
    def ambient_k(self) -> float:
        """Ambient temperature, K."""
        return self.config.ambient_c + ZERO_CELSIUS_K

    def build_cold_heat(self) -> ThermalState:
        """Heat of a display that nobody has lit."""
        return build_cold_state(self.config, self.parameters, self.pixels)

    @cached_property
    def max_displacement_m(self) -> FloatArray:
        """The largest displacement that one pulse can reach from rest, [p]."""
        return self.build_cold_heat().max_displacement_m(self.scan_head.drive)

    def build_cold_state(self) -> tuple[ThermalState, BudgetState]:
        """Heat and budget of a display that nobody has lit."""
        return self.build_cold_heat(), cold_state(len(self.pixels))


@dataclass(frozen=True)
class FrameTiming:
    """How a frame fared: when its last pulse ends against when it should, and how many pulses came in time."""

    source: int
    frame_id: str
    show_at_s: float
    deadline_s: float
    first_pulse_s: float
    end_s: float
    pulses: int
    on_time: int

    @property
    def late_s(self) -> float:
        """By how much the frame overruns its time, s."""
        late_s = self.end_s - self.deadline_s
        return late_s if late_s > TIME_TOLERANCE_S else 0.0


@dataclass(frozen=True)
class Shortfall:
    """The first pulse that a cap cut, margin_j too much; fits_later_s: how much later its whole piece would fit."""

    pixel: int
    cap: str
    margin_j: float
    fits_after_s: float


@dataclass(frozen=True)
class Delay:
    """How long a frame or train was made to wait for a cap, and for which pixel first."""

    source: int
    pixel: int
    cap: str
    wait_s: float


@dataclass(frozen=True, eq=False)
class PlannedSequence:
    """A limited plan and what is known about it before it runs. heat, budget: after the plan, on its time line.

    predicted_m: [n] largest displacement from each pulse's start to the pixel's next pulse
    together: how the frames were split whose pixels shall stand up at one time
    shortfall: under "trim", None where nothing was; delays: under "delay"
    rested_s: how long mirrors rest in all, for the sake of their coils
    dead: pixels that frames asked for and that are left out, for they are dead
    """

    sequence: FrameSequence
    plan: LimitedPlan
    predicted_m: FloatArray
    lead_in_s: float
    skipped: tuple[SkippedPulse, ...]
    frames: tuple[FrameTiming, ...]
    simultaneous: tuple[SimultaneousFrame, ...]
    shortfall: Shortfall | None
    delays: tuple[Delay, ...]
    galvo_pause_s: float
    heat: ThermalState
    budget: BudgetState
    dead_pixels: tuple[int, ...] = ()

    @property
    def duration_s(self) -> float:
        """From the plan's start to the end of its last pulse, s."""
        return float(self.plan.start_s[-1] + self.plan.width_s[-1]) if len(self.plan) else 0.0

    @property
    def train_lateness_max_s(self) -> float:
        """The most by which a pulse of a train comes after its nominal time, s."""
        late = (self.plan.start_s - self.plan.requested_start_s)[self.plan.source >= len(self.sequence.frames)]
        return float(late.max()) if len(late) else 0.0


def resolve_policy(policy: Policy, strict: bool) -> Policy:
    """`strict` is another word for policy "refuse"; InputError where both say different things."""
    if strict and policy == "delay":
        raise InputError("strict", True, "either strict or policy 'delay'")
    return "refuse" if strict else policy


def warm_up(display: DisplayModel) -> None:
    """Plan a frame and a pulse for nobody, so that every kernel is compiled and loaded."""
    warm_order()
    laser, target_m = display.config.laser, np.zeros(len(display.pixels))
    pixel = int(np.argmin(display.dead))
    target_m[pixel] = 1e-6
    trains = (
        PulseTrain(pixel, 1.0, 1e-3, 1.0 / laser.pwm_hz, 1e-3, laser.max_power_w),
        HeightTrain(pixel, 2.0, 1e-3, 0.1, 1e-6),
    )
    plan_sequence(display, FrameSequence((TactileFrame("", 0.0, 1.0, target_m),), trains), *display.build_cold_state())
    if not display.parameters.planner_terms:
        # Admission looks whether heat falls.
        display.build_cold_heat().simulate_traces(np.zeros((0, 4)), [0], np.zeros(2))
    # Telemetry looks at heat and budget while a plan runs.
    display.build_cold_heat().state_at(0.0)
    compute_usage(cold_state(len(display.pixels)), display.budget, 0.0)


def first_unreachable(display: DisplayModel, sequence: FrameSequence) -> tuple[int, int, float] | None:
    """The first target that the longest pulse at full power does not reach from rest: frame, pixel, what it reaches, m.

    None where all are within reach.
    """
    for source, frame in enumerate(sequence.frames):
        unreachable = np.flatnonzero(frame.target_m > display.max_displacement_m)
        if len(unreachable):
            return source, int(unreachable[0]), float(display.max_displacement_m[unreachable[0]])
    return None


def check_targets_reachable(display: DisplayModel, sequence: FrameSequence) -> None:
    """Refuse a target that the longest pulse at full power does not reach from rest."""
    unreachable = first_unreachable(display, sequence)
    if unreachable is None:
        return
    source, pixel, max_m = unreachable
    frame, laser, limits = sequence.frames[source], display.config.laser, display.config.limits
    raise InputError(
        f"frame {frame.frame_id}: target_um of pixel {pixel}",
        round(m_to_um(float(frame.target_m[pixel])), 3),
        f"at most {m_to_um(max_m):.0f} µm, what the longest pulse "
        f"({limits.pulse_width_max_s * 1e3:g} ms at {laser.max_power_w:g} W) reaches",
        code="target_out_of_reach",
    )


def remove_dead_pixels(display: DisplayModel, sequence: FrameSequence) -> tuple[FrameSequence, tuple[int, ...]]:
    """The sequence with dead pixels left out of its frames, and which those are.

    Raises InputError (dead_pixel) for a train on one: it asks for that pixel and no other.
    """
    if not display.dead.any():
        return sequence, ()
    for index, train in enumerate(sequence.trains):
        if display.dead[train.pixel]:
            raise InputError(
                f"trains[{index}].pixel", train.pixel, "a pixel that lives: this one is dead", "dead_pixel"
            )
    requested = np.zeros(len(display.dead), dtype=np.bool_)
    for frame in sequence.frames:
        requested |= frame.target_m > 0
    dead = np.flatnonzero(requested & display.dead)
    if not len(dead):
        return sequence, ()
    frames = tuple(replace(frame, target_m=np.where(display.dead, 0.0, frame.target_m)) for frame in sequence.frames)
    return replace(sequence, frames=frames), tuple(dead.tolist())


def plan_sequence(
    display: DisplayModel,
    sequence: FrameSequence,
    heat: ThermalState,
    budget: BudgetState,
    policy: Policy = "trim",
    on_progress: Progress | None = None,
    initial_pixel: int | None = None,
    visiting_orders: Mapping[int, IntArray] | None = None,
) -> PlannedSequence:
    """Plan and limit a sequence from the heat and budget there are, both on the plan's time line; neither is changed.

    standing_on: the pixel the mirrors stand on as the plan begins; None where that is not known.
    orders: as the scheduler takes them, in place of its own.

    Under "delay" whatever does not fit waits, with all that follows, until it does; a pulse of a train by itself, a
    frame as a whole. Raises InputError for a height or a swing out of reach, RefusedError for what no policy lets
    pass: under "refuse" a cap or a deadline that is missed, under "delay" what would never fit.
    """
    sequence, dead = remove_dead_pixels(display, sequence)
    check_targets_reachable(display, sequence)
    done = 0.0

    def report_progress() -> None:
        if on_progress is not None:
            on_progress(done)

    scheduler = Scheduler(
        display.scan_head,
        sequence,
        display.build_cold_heat,
        train_batch=1 if policy == "delay" else TRAIN_BATCH,
        on_progress=report_progress,
        initial_pixel=initial_pixel,
        visiting_orders=visiting_orders,
    )
    working_heat, state = heat.copy(), budget
    limited: list[LimitedPlan] = []
    recent: list[LimitedPlan] = []
    delays: list[Delay] = []
    shortfall: Shortfall | None = None
    pieces = scheduler.pieces(working_heat)
    galvo_pause_s = 0.0
    batch = next(pieces, None)
    while batch is not None:
        rest = find_galvo_pause(display, batch, state, len(sequence.frames))
        if rest is not None:
            galvo_pause_s += rest.pause_us * 1e-6
            batch = pieces.send(rest)
            continue
        try:
            granted, after = limit(batch, state, display.budget, policy)
        except OverBudgetError as error:
            if policy != "delay" or error.earliest_s == inf:
                raise
            delays.append(Delay(int(batch.source[0]), error.pixel, error.cap, error.earliest_s))
            batch = pieces.send(ceil(error.earliest_s * 1e6))
            continue
        if shortfall is None and granted.trimmed_j.any():
            shortfall = _build_shortfall(batch, granted, state, display.budget)
        state = after
        working_heat.apply_pulses(granted.pixel, granted.start_s, granted.width_s, granted.power_w, report_progress)
        recent.append(granted)
        if len(recent) == CONCATENATE_EVERY:
            limited, recent = [*limited, concatenate(recent, state, display.budget)], []
        done = _compute_progress(sequence, granted)
        report_progress()
        batch = next(pieces, None)
    plan = concatenate([*limited, *recent], state, display.budget)
    after_heat = heat.copy()
    predicted_m = after_heat.apply_pulses(
        plan.pixel, plan.start_s, plan.width_s, plan.power_w, report_progress
    ).displacement_m
    lead_in_s = scheduler.lead_in_us * 1e-6
    planned = PlannedSequence(
        sequence=sequence,
        plan=plan,
        predicted_m=predicted_m,
        lead_in_s=lead_in_s,
        skipped=tuple(scheduler.skipped),
        frames=_compute_frame_timings(sequence, plan, lead_in_s),
        simultaneous=tuple(scheduler.simultaneous),
        shortfall=shortfall,
        delays=_merge_delays(delays),
        galvo_pause_s=galvo_pause_s,
        heat=after_heat,
        budget=state,
        dead_pixels=dead,
    )
    if policy == "refuse":
        _refuse_late(planned)
    return planned


def find_galvo_pause(display: DisplayModel, batch: PulsePlan, state: BudgetState, frames: int) -> GalvoPause | None:
    """The rest that mirrors need within a frame's piece; None where they need none, or where none helps.

    No power makes a move right that the mirrors do not bear: a frame is drawn slower rather than with holes. A train
    keeps its times, and leaves such a pulse to the limiter.
    """
    row = galvo_feasible_prefix(batch, state, display.budget)
    averaging_s = display.budget.galvo.averaging_s
    if row == len(batch) or batch.source[row] >= frames:
        return None
    if row == 0 and galvo_feasible_prefix(batch, state, display.budget, COLD_AFTER_AVERAGING_TIMES * averaging_s) == 0:
        return None
    return GalvoPause(row, ceil(1e6 * PAUSE_FRACTION * averaging_s))


def _build_shortfall(batch: PulsePlan, granted: LimitedPlan, state: BudgetState, budget: Budget) -> Shortfall:
    row = int(np.flatnonzero(granted.reason != "")[0])
    return Shortfall(
        pixel=int(batch.pixel[row]),
        cap=str(granted.reason[row]),
        margin_j=float(granted.trimmed_j[row]),
        fits_after_s=compute_wait_s(batch, state, budget),
    )


def _merge_delays(delays: list[Delay]) -> tuple[Delay, ...]:
    """One entry for each source and cap, in order of their first wait."""
    by_source_and_cap: dict[tuple[int, str], Delay] = {}
    for delay in delays:
        key = delay.source, delay.cap
        before = by_source_and_cap.get(key, replace(delay, wait_s=0.0))
        by_source_and_cap[key] = replace(before, wait_s=before.wait_s + delay.wait_s)
    return tuple(by_source_and_cap.values())


def _compute_progress(sequence: FrameSequence, batch: PulsePlan) -> float:
    ends = [f.show_at_s + f.duration_s for f in sequence.frames] + [t.start_s + t.duration_s for t in sequence.trains]
    return min(1.0, float(batch.requested_start_s[-1]) / max(ends))


def _compute_frame_timings(sequence: FrameSequence, plan: LimitedPlan, lead_in_s: float) -> tuple[FrameTiming, ...]:
    timings = []
    end_s = plan.start_s + plan.width_s
    for source, frame in enumerate(sequence.frames):
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
                end_s=float(end_s[rows[-1]]),
                pulses=len(rows),
                on_time=int(np.count_nonzero(end_s[rows] <= deadline_s + TIME_TOLERANCE_S)),
            )
        )
    return tuple(timings)


def _refuse_late(planned: PlannedSequence) -> None:
    for timing in planned.frames:
        if timing.late_s > 0:
            raise RefusedError(describe_lateness(timing))


def describe_lateness(timing: FrameTiming) -> str:
    """One sentence with the numbers of a frame that does not fit its time."""
    return (
        f"frame {timing.frame_id} needs {timing.end_s - timing.show_at_s:.4f} s of beam time and has "
        f"{timing.deadline_s - timing.show_at_s:.4f} s: {timing.on_time} of {timing.pulses} pulses come in time, "
        f"the last ends {timing.late_s:.4f} s late"
    )
