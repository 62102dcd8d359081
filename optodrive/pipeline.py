"""Sequence to limited plan, without a board: schedule a piece, limit it, let the heat follow, predict.

The engine, `optodrive plan` and `optodrive simulate` all come through here.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optodrive.config import Config, PixelLayout, pixel_layout
from optodrive.errors import InputError, RefusedError
from optodrive.flow import BudgetState, FloatArray, FrameSequence, LimitedPlan, PulsePlan
from optodrive.limit.budget import Budget
from optodrive.limit.limiter import Policy, fresh_state, joined, limit
from optodrive.physics.array import DisplayHeat, pulse_peaks
from optodrive.physics.parameters import PixelArray, display_pixels
from optodrive.plan.drive import DriveRange, reach_m
from optodrive.plan.field import IdealField
from optodrive.plan.galvo import MoveModel
from optodrive.plan.scheduler import Machine, Scheduler, Skipped
from optodrive.units import ZERO_CELSIUS_K, m_to_um

Progress = Callable[[float], None]
"""Told the share done, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Display:
    """A configuration resolved into what the stages take."""

    config: Config
    layout: PixelLayout
    pixels: PixelArray
    machine: Machine
    budget: Budget

    @classmethod
    def of(cls, config: Config) -> "Display":
        """Resolve a configuration."""
        layout = pixel_layout(config.display)
        pixels = display_pixels(config)
        limits, laser, scanner = config.limits, config.laser, config.scanner
        machine = Machine(
            layout=layout,
            field=IdealField(scanner.focal_length_m),
            moves=MoveModel(scanner.settle_s, scanner.slew_rad_per_s),
            drive=DriveRange.of(laser.max_power_w, laser.pwm_hz, limits.pulse_width_max_s),
        )
        budget = Budget(
            gain_k_per_w=pixels.epsilon * (1.0 + limits.absorbed_power_margin) * pixels.r_k_per_w,
            tau_s=pixels.r_k_per_w * pixels.c_j_per_k,
            rise_cap_k=limits.absorber_max_c - config.ambient_c,
            pulse_energy_max_j=limits.pulse_energy_max_j,
            pulse_width_max_s=limits.pulse_width_max_s,
            pulse_rest_min_s=limits.pulse_rest_min_s,
            pixel_mean_power_max_w=limits.pixel_mean_power_max_w,
            pixel_mean_window_s=limits.pixel_mean_window_s,
            display_mean_power_max_w=limits.display_mean_power_max_w,
            display_mean_window_s=limits.display_mean_window_s,
        )
        return cls(config, layout, pixels, machine, budget)

    @property
    def ambient_k(self) -> float:
        """Ambient temperature, K."""
        return self.config.ambient_c + ZERO_CELSIUS_K

    def at_rest(self) -> tuple[DisplayHeat, BudgetState]:
        """Heat and budget of a display that nobody has lit."""
        return DisplayHeat(self.pixels), fresh_state(len(self.pixels))


@dataclass(frozen=True)
class FrameTiming:
    """How a frame fared: when its last pulse ends against when it should, and how many pulses came in time."""

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
        return max(0.0, self.finished_s - self.due_s)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A limited plan and what is known about it before it runs. heat, budget: after the plan, on its time line.

    predicted_m: [n] largest displacement from each pulse's start to the pixel's next pulse
    """

    sequence: FrameSequence
    plan: LimitedPlan
    predicted_m: FloatArray
    lead_s: float
    skipped: tuple[Skipped, ...]
    frames: tuple[FrameTiming, ...]
    heat: DisplayHeat
    budget: BudgetState

    @property
    def duration_s(self) -> float:
        """From the plan's start to the end of its last pulse, s."""
        return float(self.plan.start_s[-1] + self.plan.width_s[-1]) if len(self.plan) else 0.0

    @property
    def train_late_s(self) -> float:
        """The most by which a pulse of a train comes after its nominal time, s."""
        late = (self.plan.start_s - self.plan.nominal_s)[self.plan.source >= len(self.sequence.frames)]
        return float(late.max()) if len(late) else 0.0


def check_reach(display: Display, sequence: FrameSequence) -> None:
    """Refuse a target that the longest pulse at full power does not reach from rest."""
    if not sequence.frames:
        return
    reach = {pixel: reach_m(pixel, display.machine.drive) for pixel in set(display.pixels.each)}
    most_m = np.array([reach[pixel] for pixel in display.pixels.each])
    laser, limits = display.config.laser, display.config.limits
    for frame in sequence.frames:
        beyond = np.flatnonzero(frame.target_m > most_m)
        if len(beyond):
            index = int(beyond[0])
            raise InputError(
                f"frame {frame.frame_id}: target_um of pixel {index}",
                round(m_to_um(float(frame.target_m[index])), 3),
                f"at most {m_to_um(float(most_m[index])):.0f} µm, what the longest pulse "
                f"({limits.pulse_width_max_s * 1e3:g} ms at {laser.max_power_w:g} W) reaches",
                code="target_out_of_reach",
            )


def prepare(
    display: Display,
    sequence: FrameSequence,
    heat: DisplayHeat,
    budget: BudgetState,
    policy: Policy = "trim",
    progress: Progress | None = None,
) -> Prepared:
    """Plan and limit a sequence from the heat and budget there are, both on the plan's time line; neither is changed.

    Raises InputError for a target out of reach, RefusedError under policy "refuse" where a cap or a deadline is missed.
    """
    check_reach(display, sequence)
    scheduler = Scheduler(display.machine, sequence)
    working = heat.copy()
    pieces: list[LimitedPlan] = []
    for piece in scheduler.pieces(working):
        limited, budget = limit(piece, budget, display.budget, policy)
        _heat_by(working, limited)
        pieces.append(limited)
        if progress is not None:
            progress(_share_done(sequence, limited))
    plan = joined(pieces, budget, display.budget)
    after = heat.copy()
    predicted_m = pulse_peaks(after, plan.pixel, plan.start_s, plan.width_s, plan.power_w)
    lead_s = scheduler.lead_us * 1e-6
    prepared = Prepared(
        sequence=sequence,
        plan=plan,
        predicted_m=predicted_m,
        lead_s=lead_s,
        skipped=tuple(scheduler.skipped),
        frames=_frame_timings(sequence, plan, lead_s),
        heat=after,
        budget=budget,
    )
    if policy == "refuse":
        _refuse_late(prepared)
    return prepared


def _heat_by(heat: DisplayHeat, plan: PulsePlan) -> None:
    rows = zip(plan.pixel.tolist(), plan.start_s.tolist(), plan.width_s.tolist(), plan.power_w.tolist(), strict=True)
    for pixel, start_s, width_s, power_w in rows:
        heat.pulse(pixel, start_s, width_s, power_w)


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
                frame_id=frame.frame_id,
                show_at_s=lead_s + frame.show_at_s,
                due_s=due_s,
                first_s=float(plan.start_s[rows[0]]),
                finished_s=float(end_s[rows[-1]]),
                pulses=len(rows),
                in_time=int(np.count_nonzero(end_s[rows] <= due_s + 1e-9)),
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
        f"frame {timing.frame_id} needs {timing.finished_s - timing.show_at_s:.3f} s of beam time and has "
        f"{timing.due_s - timing.show_at_s:.3f} s: {timing.in_time} of {timing.pulses} pulses come in time, "
        f"the last ends {timing.late_s:.3f} s late"
    )
