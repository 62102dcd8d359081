"""The summary of a plan and its pulses, as the command line prints them and the daemon sends them."""

from optodrive.core.json_model import FloatColumn, IntColumn, JsonModel, OptionalFloatColumn, TextColumn
from optodrive.planning.feasibility.report import FeasibilityReport

GALVO_PAUSED_FRACTION = 0.2
"""Share of a plan's time in pauses of the mirrors from which on they count as what limits it."""


class TrimmedPulse(JsonModel):
    """One pulse that the limiter reduced. `target_um` is None for a pulse of a train given by its width.

    pixel: of the pulse
    start_s: time from the plan's zero, s
    trimmed_j: energy that was removed, J
    reason: caps that removed it
    predicted_um: height that is left, µm
    target_um: requested height, µm, null for a pulse of a train given by its width
    """

    pixel: int
    start_s: float
    trimmed_j: float
    reason: str
    predicted_um: float
    target_um: float | None


class TrimmingSummary(JsonModel):
    """Energy that the limiter removed, by cap. `worst` lists up to 20 pulses, the largest reduction first.

    pulses: number of pulses that were reduced
    energy_j: energy that was removed, J
    by_reason: number of pulses by the caps that reduced them
    worst: up to 20 pulses, the largest reduction first
    """

    pulses: int
    energy_j: float
    by_reason: dict[str, int]
    worst: list[TrimmedPulse]


class ShortfallSummary(JsonModel):
    """The first pulse that a cap reduced. `fits_after_s` is None if no delay makes it fit.

    pixel: of the pulse
    cap: that reduced it
    margin_j: energy by which the pulse exceeds the cap, J
    fits_after_s: delay after which all of it fits, s, null if none helps
    """

    pixel: int
    cap: str
    margin_j: float
    fits_after_s: float | None


class DelaySummary(JsonModel):
    """Time that a frame or train waited for a cap, and the first pixel that needed it.

    source: id of the frame, or the train
    pixel: the first one that had to wait
    cap: for which it waited
    wait_s: time by which it waited, s
    """

    source: str
    pixel: int
    cap: str
    wait_s: float


class DeadPixelSummary(JsonModel):
    """Dead pixels that the frames request and the plan omits. `message` is None if there are none.

    pixels: indices of the dead pixels
    count: their number
    message: them in a sentence, null without any
    """

    pixels: list[int]
    count: int
    message: str | None


class SkippedTarget(JsonModel):
    """A target that needs no pulse.

    frame: id of the frame
    pixel: of the target
    target_um: requested height, µm
    reason: why it needs no pulse
    """

    frame: str
    pixel: int
    target_um: float
    reason: str


class CyclePeak(JsonModel):
    """Predicted peak of one cycle of a train, counted from 1.

    cycle: number of the cycle, from 1
    peak_um: predicted peak, µm
    """

    cycle: int
    peak_um: float


class OffTargetTrain(JsonModel):
    """A train by height whose predicted peaks differ from its target by more than 2 %.

    cycles, off_target: number of its cycles, and of those whose peak differs; min_um, max_um: smallest and largest of
    these peaks; peaks: the first 20 of them; message: all of this in a sentence
    train: name of the train
    pixel: of the train
    target_um: requested height of the peaks, µm
    """

    train: str
    pixel: int
    target_um: float
    cycles: int
    off_target: int
    min_um: float
    max_um: float
    peaks: list[CyclePeak]
    message: str


class OffTargetSummary(JsonModel):
    """Trains by height with predicted peaks more than 2 % off their target: number, and the first 20.

    count: number of these trains
    trains: the first 20 of them
    """

    count: int
    trains: list[OffTargetTrain]


class PixelIntervals(JsonModel):
    """The times between the pulses of one pixel in frames that repeat.

    pixel: index of the pixel
    period_s: of the frames
    min_s, max_s: shortest and longest time between two pulses, s
    """

    pixel: int
    period_s: float
    min_s: float
    max_s: float


class RepeatSummary(JsonModel):
    """Times between the pulses of pixels in frames that repeat: with the same pixels as the one before.

    pixels: number of these pixels; min_s, max_s: shortest and longest time of all
    off_period: number of pixels with a time that differs from the frames' by more than 5 % of their period;
    worst: up to 20 of these, the largest difference first; message: a sentence about them, None without any
    """

    pixels: int
    min_s: float
    max_s: float
    off_period: int
    worst: list[PixelIntervals]
    message: str | None


class RedrawnSummary(JsonModel):
    """Times since the last pulse of a streamed frame's pixels, of those that the stream has drawn before.

    pixels: number of these
    min_s, max_s: shortest and longest time, s
    """

    pixels: int
    min_s: float
    max_s: float


class SimultaneitySummary(JsonModel):
    """How the pulses of a simultaneous frame were interleaved.

    `simultaneity_single_pulse`: without interleaving
    interleaved_rounds: number of rounds of sub-pulses
    simultaneity: largest share of their targets that all pixels have at one time
    simultaneity_single_pulse: the same with one pulse per pixel
    extra_s: beam time that the rounds take more, s
    """

    interleaved_rounds: int
    simultaneity: float
    simultaneity_single_pulse: float
    extra_s: float


class FrameSummary(JsonModel):
    """Times of one frame on the plan's time line, s. `on_time` counts its pulses that end before the deadline.

    frame: id of the frame
    show_at_s, deadline_s: times at which the frame begins and must be drawn
    first_pulse_s, end_s: start of its first pulse and end of its last one
    late_s: time by which it ends after its deadline, 0 if it does not
    pulses, on_time: number of its pulses, and of those that end in time
    simultaneous: how its pulses were interleaved, null unless it is a simultaneous frame
    """

    frame: str
    show_at_s: float
    first_pulse_s: float
    end_s: float
    deadline_s: float
    late_s: float
    pulses: int
    on_time: int
    simultaneous: SimultaneitySummary | None


class PlanSummary(JsonModel):
    """A limited plan: feasibility, timing, energy, predicted displacement, and the limiter's changes.

    feasibility: None if it was not requested (a stream)
    predicted_max_pixel, predicted_max_um, predicted_max_target_um: the pulse with the largest predicted displacement
    target_max_um: the largest target
    repeats: None if no frame repeats; redrawn: None but for a streamed frame with pixels that were drawn before
    beam_on_s: of all stages together; beam_on_fraction: of the time of all stages
    early_step_s: time by which steps precede the end of the light, 0 if they follow it
    pulses: number of pulses
    duration_s: from the plan's zero to the end of its last pulse, s
    settling_s: time for which the gate waits for the mirrors, s
    lead_in_s: time from the plan's zero to its first pulse, s
    galvo_pause_s: time of the pauses in which the mirrors' coils cool, s
    energy_j: incident energy of all pulses, J
    headroom_min_k: smallest distance of an absorber to its cap, K
    trimmed: what the limiter removed
    shortfall: first pulse that a cap reduced, null without one
    off_target: trains by height that miss it
    delays: frames and trains that waited for a cap
    dead: dead pixels that were requested and left out
    skipped: targets that need no pulse
    frames: times of each frame
    late_messages: frames that miss their deadlines, in sentences
    train_lateness_max_s: longest delay of a train's pulse after its requested start, s
    """

    feasibility: FeasibilityReport | None
    pulses: int
    duration_s: float
    beam_on_s: float
    beam_on_fraction: float
    settling_s: float
    lead_in_s: float
    galvo_pause_s: float
    early_step_s: float
    energy_j: float
    predicted_max_pixel: int | None
    predicted_max_um: float
    predicted_max_target_um: float | None
    target_max_um: float
    headroom_min_k: float
    trimmed: TrimmingSummary
    shortfall: ShortfallSummary | None
    off_target: OffTargetSummary
    repeats: RepeatSummary | None
    redrawn: RedrawnSummary | None
    delays: list[DelaySummary]
    dead: DeadPixelSummary
    skipped: list[SkippedTarget]
    frames: list[FrameSummary]
    late_messages: list[str]
    train_lateness_max_s: float

    @property
    def limited_by(self) -> list[str]:
        """Caps that took light from the plan, by name: those that trimmed it, and the mirrors' by long pauses."""
        pauses = self.galvo_pause_s > GALVO_PAUSED_FRACTION * self.duration_s
        return sorted({*self.trimmed.by_reason, *(["galvo_acceleration"] if pauses else [])})


class PulseColumns(JsonModel):
    """The pulses of a plan by column, in order. `target_um` is None for a pulse without a target height.

    stage: number of the pulse's stage, in the order of the configuration, from 0
    start_s, width_s: time from the plan's zero at which the gate opens, and for how long, s
    power_w: power at the sample, W
    pixel: of each pulse
    energy_j, trimmed_j: incident energy, and energy that the limiter removed, J
    reason: caps that removed it, empty without one
    target_um: requested height, µm, null without one
    predicted_um: highest displacement of the pixel until its next pulse, µm
    """

    start_s: FloatColumn
    width_s: FloatColumn
    power_w: FloatColumn
    pixel: IntColumn
    stage: IntColumn
    energy_j: FloatColumn
    trimmed_j: FloatColumn
    reason: TextColumn
    target_um: OptionalFloatColumn
    predicted_um: FloatColumn
