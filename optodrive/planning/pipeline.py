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
from optodrive.device.config import Config, PixelLayout, pixel_layout
from optodrive.device.field_loader import field_of, moves_of
from optodrive.device.pixel_map import aimed_layout, map_of
from optodrive.physics.parameters import ParameterSet, PixelArray, display_pixels, load_parameters
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import Heat, heat_at_rest
from optodrive.planning.budget_setup import budget_of
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import Policy, fresh_state, joined, limit, moves_borne, wait_s
from optodrive.planning.limiter.usage import usage
from optodrive.planning.scheduler.interleaving import Together
from optodrive.planning.scheduler.scheduler import TRAIN_PIECE, Machine, Rest, Scheduler, Skipped
from optodrive.planning.scheduler.visiting_path import warm as warm_order

JOINED = 256
"""Pieces joined at a time: each carries the headroom of every pixel, and a piece may be a single pulse."""

REST = 0.1
"""Mirrors rest for this share of the time over which their coils' heat is averaged."""
MEANS_COOLED = 50.0

Progress = Callable[[float], None]
"""Told the share done, 0 to 1."""
ROUNDING_S = 1e-9
"""Times are whole microseconds; sums of them may be off by this much."""


@dataclass(frozen=True, eq=False)
class Display:
    """A configuration resolved into what the stages take.

    layout: where pixels lie; the machine's says where the beam is sent for them. dead: [p] which are known to be dead
    """

    config: Config
    layout: PixelLayout
    parameters: ParameterSet
    pixels: PixelArray
    dead: BoolArray
    machine: Machine
    budget: Budget

    @classmethod
    def of(cls, config: Config) -> "Display":
        """Resolve a configuration."""
        layout, known = pixel_layout(config.display), map_of(config)
        parameters = load_parameters(config.pixel_model.parameters)
        pixels = display_pixels(config, parameters)
        limits, laser = config.limits, config.laser
        machine = Machine(
            layout=aimed_layout(config),
            field=field_of(config),
            moves=moves_of(config),
            drive=DriveRange.of(laser.max_power_w, laser.pwm_hz, limits.pulse_width_max_s),
            rest_s=limits.pulse_rest_min_s,
        )
        dead = np.zeros(len(layout), dtype=np.bool_) if known is None else known.dead
        return cls(config, layout, parameters, pixels, dead, machine, budget_of(config, parameters, pixels))

    @property
    def ambient_k(self) -> float:
        """Ambient temperature, K."""
        return self.config.ambient_c + ZERO_CELSIUS_K

    def heat_at_rest(self) -> Heat:
        """Heat of a display that nobody has lit."""
        return heat_at_rest(self.config, self.parameters, self.pixels)

    @cached_property
    def reach_m(self) -> FloatArray:
        """The largest displacement that one pulse can reach from rest, [p]."""
        return self.heat_at_rest().reaches_m(self.machine.drive)

    def at_rest(self) -> tuple[Heat, BudgetState]:
        """Heat and budget of a display that nobody has lit."""
        return self.heat_at_rest(), fresh_state(len(self.pixels))


@dataclass(frozen=True)
class FrameTiming:
    """How a frame fared: when its last pulse ends against when it should, and how many pulses came in time."""

    source: int
    frame_id: str
    show_at_s: float
    due_s: float
    first_s: float
    finished_s: float
    pulses: int
    in_time: int

    @property
    def late_s(self) -> float:
        """By how much the frame overruns its time, s."""
        late_s = self.finished_s - self.due_s
        return late_s if late_s > ROUNDING_S else 0.0


@dataclass(frozen=True)
class Shortfall:
    """The first pulse that a cap cut, margin_j too much; fits_later_s: how much later its whole piece would fit."""

    pixel: int
    cap: str
    margin_j: float
    fits_later_s: float


@dataclass(frozen=True)
class Delay:
    """How long a frame or train was made to wait for a cap, and for which pixel first."""

    source: int
    pixel: int
    cap: str
    wait_s: float


@dataclass(frozen=True, eq=False)
class Prepared:
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
    lead_s: float
    skipped: tuple[Skipped, ...]
    frames: tuple[FrameTiming, ...]
    together: tuple[Together, ...]
    shortfall: Shortfall | None
    delays: tuple[Delay, ...]
    rested_s: float
    heat: Heat
    budget: BudgetState
    dead: tuple[int, ...] = ()

    @property
    def duration_s(self) -> float:
        """From the plan's start to the end of its last pulse, s."""
        return float(self.plan.start_s[-1] + self.plan.width_s[-1]) if len(self.plan) else 0.0

    @property
    def train_late_s(self) -> float:
        """The most by which a pulse of a train comes after its nominal time, s."""
        late = (self.plan.start_s - self.plan.nominal_s)[self.plan.source >= len(self.sequence.frames)]
        return float(late.max()) if len(late) else 0.0


def chosen(policy: Policy, strict: bool) -> Policy:
    """`strict` is another word for policy "refuse"; InputError where both say different things."""
    if strict and policy == "delay":
        raise InputError("strict", True, "either strict or policy 'delay'")
    return "refuse" if strict else policy


def warm_up(display: Display) -> None:
    """Plan a frame and a pulse for nobody, so that every kernel is compiled and loaded."""
    warm_order()
    laser, target_m = display.config.laser, np.zeros(len(display.pixels))
    pixel = int(np.argmin(display.dead))
    target_m[pixel] = 1e-6
    trains = (
        PulseTrain(pixel, 1.0, 1e-3, 1.0 / laser.pwm_hz, 1e-3, laser.max_power_w),
        HeightTrain(pixel, 2.0, 1e-3, 0.1, 1e-6),
    )
    prepare(display, FrameSequence((TactileFrame("", 0.0, 1.0, target_m),), trains), *display.at_rest())
    if not display.parameters.planner_terms:
        # Admission looks whether heat falls.
        display.heat_at_rest().traces(np.zeros((0, 4)), [0], np.zeros(2))
    # Telemetry looks at heat and budget while a plan runs.
    display.heat_at_rest().at(0.0)
    usage(fresh_state(len(display.pixels)), display.budget, 0.0)


def beyond_reach(display: Display, sequence: FrameSequence) -> tuple[int, int, float] | None:
    """The first target that the longest pulse at full power does not reach from rest: frame, pixel, what it reaches, m.

    None where all are within reach.
    """
    for source, frame in enumerate(sequence.frames):
        beyond = np.flatnonzero(frame.target_m > display.reach_m)
        if len(beyond):
            return source, int(beyond[0]), float(display.reach_m[beyond[0]])
    return None


def check_reach(display: Display, sequence: FrameSequence) -> None:
    """Refuse a target that the longest pulse at full power does not reach from rest."""
    beyond = beyond_reach(display, sequence)
    if beyond is None:
        return
    source, pixel, most_m = beyond
    frame, laser, limits = sequence.frames[source], display.config.laser, display.config.limits
    raise InputError(
        f"frame {frame.frame_id}: target_um of pixel {pixel}",
        round(m_to_um(float(frame.target_m[pixel])), 3),
        f"at most {m_to_um(most_m):.0f} µm, what the longest pulse "
        f"({limits.pulse_width_max_s * 1e3:g} ms at {laser.max_power_w:g} W) reaches",
        code="target_out_of_reach",
    )


def without_dead(display: Display, sequence: FrameSequence) -> tuple[FrameSequence, tuple[int, ...]]:
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
    asked = np.zeros(len(display.dead), dtype=np.bool_)
    for frame in sequence.frames:
        asked |= frame.target_m > 0
    dead = np.flatnonzero(asked & display.dead)
    if not len(dead):
        return sequence, ()
    frames = tuple(replace(frame, target_m=np.where(display.dead, 0.0, frame.target_m)) for frame in sequence.frames)
    return replace(sequence, frames=frames), tuple(dead.tolist())


def prepare(
    display: Display,
    sequence: FrameSequence,
    heat: Heat,
    budget: BudgetState,
    policy: Policy = "trim",
    progress: Progress | None = None,
    standing_on: int | None = None,
    orders: Mapping[int, IntArray] | None = None,
) -> Prepared:
    """Plan and limit a sequence from the heat and budget there are, both on the plan's time line; neither is changed.

    standing_on: the pixel the mirrors stand on as the plan begins; None where that is not known.
    orders: as the scheduler takes them, in place of its own.

    Under "delay" whatever does not fit waits, with all that follows, until it does; a pulse of a train by itself, a
    frame as a whole. Raises InputError for a height or a swing out of reach, RefusedError for what no policy lets
    pass: under "refuse" a cap or a deadline that is missed, under "delay" what would never fit.
    """
    sequence, dead = without_dead(display, sequence)
    check_reach(display, sequence)
    done = 0.0

    def tick() -> None:
        if progress is not None:
            progress(done)

    scheduler = Scheduler(
        display.machine,
        sequence,
        display.heat_at_rest,
        train_piece=1 if policy == "delay" else TRAIN_PIECE,
        tick=tick,
        standing_on=standing_on,
        orders=orders,
    )
    working, state = heat.copy(), budget
    limited: list[LimitedPlan] = []
    waiting: list[LimitedPlan] = []
    delays: list[Delay] = []
    shortfall: Shortfall | None = None
    pieces = scheduler.pieces(working)
    rested_s = 0.0
    piece = next(pieces, None)
    while piece is not None:
        rest = mirrors_rest(display, piece, state, len(sequence.frames))
        if rest is not None:
            rested_s += rest.us * 1e-6
            piece = pieces.send(rest)
            continue
        try:
            passed, after = limit(piece, state, display.budget, policy)
        except OverBudgetError as error:
            if policy != "delay" or error.earliest_s == inf:
                raise
            delays.append(Delay(int(piece.source[0]), error.pixel, error.cap, error.earliest_s))
            piece = pieces.send(ceil(error.earliest_s * 1e6))
            continue
        if shortfall is None and passed.trimmed_j.any():
            shortfall = _shortfall(piece, passed, state, display.budget)
        state = after
        working.pulses(passed.pixel, passed.start_s, passed.width_s, passed.power_w, tick)
        waiting.append(passed)
        if len(waiting) == JOINED:
            limited, waiting = [*limited, joined(waiting, state, display.budget)], []
        done = _share_done(sequence, passed)
        tick()
        piece = next(pieces, None)
    plan = joined([*limited, *waiting], state, display.budget)
    after_heat = heat.copy()
    predicted_m = after_heat.pulses(plan.pixel, plan.start_s, plan.width_s, plan.power_w, tick).displacement_m
    lead_s = scheduler.lead_us * 1e-6
    prepared = Prepared(
        sequence=sequence,
        plan=plan,
        predicted_m=predicted_m,
        lead_s=lead_s,
        skipped=tuple(scheduler.skipped),
        frames=_frame_timings(sequence, plan, lead_s),
        together=tuple(scheduler.together),
        shortfall=shortfall,
        delays=_merged(delays),
        rested_s=rested_s,
        heat=after_heat,
        budget=state,
        dead=dead,
    )
    if policy == "refuse":
        _refuse_late(prepared)
    return prepared


def mirrors_rest(display: Display, piece: PulsePlan, state: BudgetState, frames: int) -> Rest | None:
    """The rest that mirrors need within a frame's piece; None where they need none, or where none helps.

    No power makes a move right that the mirrors do not bear: a frame is drawn slower rather than with holes. A train
    keeps its times, and leaves such a pulse to the limiter.
    """
    row = moves_borne(piece, state, display.budget)
    mean_s = display.budget.mirrors.mean_s
    if row == len(piece) or piece.source[row] >= frames:
        return None
    if row == 0 and moves_borne(piece, state, display.budget, MEANS_COOLED * mean_s) == 0:
        return None
    return Rest(row, ceil(1e6 * REST * mean_s))


def _shortfall(piece: PulsePlan, passed: LimitedPlan, state: BudgetState, budget: Budget) -> Shortfall:
    row = int(np.flatnonzero(passed.reason != "")[0])
    return Shortfall(
        pixel=int(piece.pixel[row]),
        cap=str(passed.reason[row]),
        margin_j=float(passed.trimmed_j[row]),
        fits_later_s=wait_s(piece, state, budget),
    )


def _merged(delays: list[Delay]) -> tuple[Delay, ...]:
    """One entry for each source and cap, in order of their first wait."""
    merged: dict[tuple[int, str], Delay] = {}
    for delay in delays:
        key = delay.source, delay.cap
        before = merged.get(key, replace(delay, wait_s=0.0))
        merged[key] = replace(before, wait_s=before.wait_s + delay.wait_s)
    return tuple(merged.values())


def _share_done(sequence: FrameSequence, piece: PulsePlan) -> float:
    ends = [f.show_at_s + f.duration_s for f in sequence.frames] + [t.start_s + t.duration_s for t in sequence.trains]
    return min(1.0, float(piece.nominal_s[-1]) / max(ends))


def _frame_timings(sequence: FrameSequence, plan: LimitedPlan, lead_s: float) -> tuple[FrameTiming, ...]:
    timings = []
    end_s = plan.start_s + plan.width_s
    for source, frame in enumerate(sequence.frames):
        rows = np.flatnonzero(plan.source == source)
        if not len(rows):
            continue
        due_s = lead_s + frame.show_at_s + frame.duration_s
        timings.append(
            FrameTiming(
                source=source,
                frame_id=frame.frame_id,
                show_at_s=lead_s + frame.show_at_s,
                due_s=due_s,
                first_s=float(plan.start_s[rows[0]]),
                finished_s=float(end_s[rows[-1]]),
                pulses=len(rows),
                in_time=int(np.count_nonzero(end_s[rows] <= due_s + ROUNDING_S)),
            )
        )
    return tuple(timings)


def _refuse_late(prepared: Prepared) -> None:
    for timing in prepared.frames:
        if timing.late_s > 0:
            raise RefusedError(lateness(timing))


def lateness(timing: FrameTiming) -> str:
    """One sentence with the numbers of a frame that does not fit its time."""
    return (
        f"frame {timing.frame_id} needs {timing.finished_s - timing.show_at_s:.4f} s of beam time and has "
        f"{timing.due_s - timing.show_at_s:.4f} s: {timing.in_time} of {timing.pulses} pulses come in time, "
        f"the last ends {timing.late_s:.4f} s late"
    )
