"""The result of planning a sequence: the limited plan, its predicted effect and its timing."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.plans import BudgetState, LimitedPlan
from optodrive.core.types.stimuli import FrameSequence
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.scheduler.batch_draft import SkippedPulse
from optodrive.planning.scheduler.interleaving import SimultaneousFrame

TIME_TOLERANCE_S = 1e-9
"""Rounding error of sums of times, which are whole microseconds."""


@dataclass(frozen=True)
class FrameTiming:
    """Timing of a frame against its deadline.

    on_time: number of its pulses that end by the deadline
    """

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
        """Time from the deadline to the end of the last pulse, s, or 0 if the frame meets its deadline."""
        late_s = self.end_s - self.deadline_s
        return late_s if late_s > TIME_TOLERANCE_S else 0.0


@dataclass(frozen=True)
class Shortfall:
    """The first trimmed pulse: the energy removed from it, and the delay after which its whole batch would fit."""

    pixel: int
    cap: str
    margin_j: float
    fits_after_s: float


@dataclass(frozen=True)
class Delay:
    """Total delay of a frame or train for one cap.

    pixel: the first pixel that caused it
    """

    source: int
    pixel: int
    cap: str
    wait_s: float


@dataclass(frozen=True, eq=False)
class TrainPeaks:
    """Predicted peaks of a train by height: `peak_m` [c], the largest displacement of each of its cycles, m."""

    source: int
    pixel: int
    target_m: float
    peak_m: FloatArray


@dataclass(frozen=True, eq=False)
class PlannedSequence:
    """A limited plan with its prediction. Heat and budget are those after the plan, on the plan's time line.

    predicted_m: [n] largest displacement from each pulse's start to the pixel's next pulse
    simultaneous: frames split into interleaved rounds
    train_peaks: of the trains by height
    shortfall: under policy "trim", None if no pulse was trimmed; delays: under policy "delay"
    galvo_pause_s: total of the pauses in which the mirrors' coils cool
    early_step_s: time by which steps precede the end of the light on a pixel where the mirrors have come to rest
    dead_pixels: dead pixels that frames requested and that were omitted
    """

    sequence: FrameSequence
    plan: LimitedPlan
    predicted_m: FloatArray
    lead_in_s: float
    skipped: tuple[SkippedPulse, ...]
    frames: tuple[FrameTiming, ...]
    simultaneous: tuple[SimultaneousFrame, ...]
    train_peaks: tuple[TrainPeaks, ...]
    shortfall: Shortfall | None
    delays: tuple[Delay, ...]
    galvo_pause_s: float
    early_step_s: float
    heat: ThermalState
    budget: BudgetState
    dead_pixels: tuple[int, ...] = ()

    @property
    def stage_count(self) -> int:
        """Number of optical stages."""
        return len(self.budget.beam_end_s)

    @property
    def duration_s(self) -> float:
        """Time from the plan's start to the end of its last pulse, s."""
        return self.plan.end_s

    @property
    def sequence_target_m(self) -> FloatArray:
        """Largest target of each pixel in the frames, m, [p]."""
        return np.asarray(np.max([frame.target_m for frame in self.sequence.frames], axis=0), dtype=np.float64)

    @property
    def train_lateness_max_s(self) -> float:
        """Largest delay of a train pulse after its requested start, s."""
        late = (self.plan.start_s - self.plan.requested_start_s)[self.plan.source >= len(self.sequence.frames)]
        return float(late.max()) if len(late) else 0.0


def explain_nothing_raised(planned: PlannedSequence) -> str:
    """Say why a plan raises no pixel, or return an empty text if it raises one or the heat left in one does."""
    plan = planned.plan
    emitting = int(np.count_nonzero((plan.power_w > 0.0) & (plan.width_s > 0.0)))
    if emitting:
        return ""
    if planned.skipped:
        pixel, target_m = np.array([(pulse.pixel, pulse.target_m) for pulse in planned.skipped]).T
        height_m = planned.heat.state_at(planned.duration_s).displacement_m[pixel.astype(np.int64)]
        # A skipped pixel is up already, by the heat that is left, or the laser emits no pulse as weak as it needs.
        is_up = bool((height_m > 0.5 * target_m).any())
        return "" if is_up else "no pixel is raised: every pulse is weaker than laser.threshold_w"
    if len(plan):
        caps = ", ".join(sorted(set(plan.reason[plan.reason != ""].tolist())))
        return f"no pixel is raised: the caps leave no light ({caps})"
    if planned.dead_pixels:
        return "no pixel is raised: every requested pixel is dead"
    return "no pixel is raised: every target is 0"


def describe_lateness(timing: FrameTiming) -> str:
    """Return a sentence that gives the numbers of a frame that misses its deadline."""
    return (
        f"frame {timing.frame_id} needs {timing.end_s - timing.show_at_s:.4f} s of beam time and has "
        f"{timing.deadline_s - timing.show_at_s:.4f} s: {timing.on_time} of {timing.pulses} pulses come in time, "
        f"the last ends {timing.late_s:.4f} s late"
    )
