"""Schedule frames and trains onto the beams of all stages: start, width and power of every pulse, batch by batch.

Trains keep their times; the pulses of a frame fill the beam time between them. Within a plan a pixel belongs to one
stage. Pulses requested by height are planned from the residual heat. All times inside the scheduler are whole
microseconds.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass
from math import inf
from typing import NamedTuple, TypeVar

import numpy as np

from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import PulsePlan
from optodrive.core.types.stimuli import FrameSequence
from optodrive.physics.nominal_display import ignore_progress
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.scheduler.batch_draft import BatchDraft, BeamState, PlanState, SkippedPulse
from optodrive.planning.scheduler.batch_planner import BatchPlanner, Round, StageTools
from optodrive.planning.scheduler.interleaving import (
    ROUND_COUNTS,
    CandidateSchedule,
    PeriodsByPixel,
    SimultaneousFrame,
    compute_simultaneity,
    concatenate_batches,
    has_min_gaps,
    select_schedule,
    split_pulses,
)
from optodrive.planning.scheduler.scan_head import BeamPath, ScanHead
from optodrive.planning.scheduler.stage_assignment import StageAssignment
from optodrive.planning.scheduler.train_pulses import TrainPulses

TRAIN_BATCH = 1000
"""Default maximum number of train pulses in one batch."""

Granted = TypeVar("Granted", bound=PulsePlan)


class GalvoPause(NamedTuple):
    """A pause of a stage's mirrors after the first `rows` pulses of a batch, in which their coils cool."""

    rows: int
    stage: int
    pause_us: int


@dataclass(frozen=True)
class _TrainsBefore:
    """Step: all train pulses requested before `until_us`."""

    until_us: float


@dataclass(frozen=True)
class _Frame:
    """Step: a frame whose visiting order and rounds are decided when the plan reaches it."""

    source: int


class Scheduler:
    """Plans a sequence batch by batch. A batch is a proposal until it is accepted.

    Exactly one of `accept`, `delay` and `pause` answers each batch from `next_batch`. Accepted pulses are applied to
    the heat before the next batch is planned, so the next batch accounts for what the limiter removed. `run` drives
    this protocol.

    assignment: of the pixels to the stages
    build_cold_heat: makes the heat of a cold display, for the pulse recipes of trains by height
    train_batch: maximum number of train pulses in one batch
    on_progress: called repeatedly while a batch is planned
    initial_pixels: pixel on which each stage's mirrors stand at the start, None while unknown
    visiting_orders: by source, the order [k] of a frame's active pixels; other frames follow a short path
    lead_in_us: gate-off time before the sequence's zero, in which all mirrors reach their first pixel from anywhere;
    zero if the initial pixels are known
    until_us: a batch ends with the first pulse that ends then or later, and the next goes on behind it
    skipped, simultaneous: skipped pulses and interleaved frames of the plan so far

    Raises InputError for a train by height whose height or peak-to-peak value no cycle has, or that has no beam time.
    """

    def __init__(
        self,
        scan_heads: tuple[ScanHead, ...],
        assignment: StageAssignment,
        sequence: FrameSequence,
        build_cold_heat: Callable[[], ThermalState],
        train_batch: int = TRAIN_BATCH,
        on_progress: Callable[[], None] = ignore_progress,
        initial_pixels: tuple[int, ...] | None = None,
        visiting_orders: Mapping[int, IntArray] | None = None,
    ) -> None:
        self._sequence = sequence
        self._scan_heads = scan_heads
        self._assignment = assignment
        self._on_progress = on_progress
        self._visiting_orders = visiting_orders or {}
        lead_ins_us = [scan_head.settling.lead_in_us for scan_head in scan_heads]
        # The longest of all stages: the plan has one zero.
        self.lead_in_us = max(lead_ins_us) if initial_pixels is None else 0
        self.until_us = inf
        self.skipped: list[SkippedPulse] = []
        self._orders: dict[int, list[int]] = {}  # of the last frame, by stage
        self.simultaneous: list[SimultaneousFrame] = []
        tools = []
        for stage, scan_head in enumerate(scan_heads):
            path = BeamPath(scan_head, self.lead_in_us)
            trains = TrainPulses(
                {
                    source: train
                    for source, train in enumerate(sequence.trains, len(sequence.frames))
                    if assignment.stage_of[train.pixel] == stage
                },
                len(sequence.frames),
                scan_head.drive,
                round(scan_head.pulse_gap_s * 1e6),
                path.compute_settling_us,
                build_cold_heat,
                on_progress,
            )
            tools.append(StageTools(path, scan_head.drive, trains))
        self._tools = tuple(tools)
        self._planner = BatchPlanner(sequence, self._tools, train_batch, on_progress)
        self._state = PlanState([BeamState(pixel=pixel) for pixel in initial_pixels or (None,) * len(scan_heads)])
        self._steps: deque[_TrainsBefore | _Frame | Round] = deque(_list_steps(sequence))
        self._draft: BatchDraft | None = None
        self._kept: BatchDraft | None = None
        self._pending_pause: GalvoPause | None = None

    def run(self, heat: ThermalState, grant: Callable[[PulsePlan], Granted | None]) -> Iterator[Granted]:
        """Plan every batch, submit it to `grant`, yield the granted pulses and then apply them to `heat`.

        grant: returns the batch as the limiter passes it, or None after it called `delay` or `pause`.
        """
        while (batch := self.next_batch(heat)) is not None:
            granted = grant(batch)
            if granted is not None:
                self.accept()
                yield granted
                # After the yield: the caller may stop in between, and this heat is only for the next batch.
                heat.apply_pulses(granted.pixel, granted.start_s, granted.width_s, granted.power_w, self._on_progress)

    def next_batch(self, heat: ThermalState) -> PulsePlan | None:
        """Plan the next batch from `heat`, which is on the plan's time line. Return None after the last batch."""
        while self._steps:
            step = self._steps[0]
            if isinstance(step, _Frame):
                self._steps.popleft()
                self._steps.extendleft(reversed(self._plan_frame(step.source, heat)))
                continue
            if isinstance(step, Round):
                draft = self._draft_round(step, heat)
            else:
                draft = self._planner.plan_trains(self._state, step.until_us, heat)
            if draft.rows:
                self._draft = draft
                return draft.to_plan()
            # An empty draft may still have skipped pulses, which belong to the plan.
            self._commit(draft)
            self._kept = None
            self._state.begin_order()
            self._steps.popleft()
        return None

    def _draft_round(self, step: Round, heat: ThermalState) -> BatchDraft:
        """Draft the pulses of a round. Those before the batch's last pause are the ones that were proposed before."""
        kept = self._kept or self._planner.begin(self._state)
        if self._pending_pause is not None:
            self._planner.extend_round(kept, step, heat, self._pending_pause.rows)
            # A pause is beam time in which nothing happens: the pulses behind it are planned from the heat of then.
            kept.state.beams[self._pending_pause.stage].free_us += self._pending_pause.pause_us
            self._kept, self._pending_pause = kept, None
        draft = kept.copy()
        self._planner.extend_round(draft, step, heat, until_us=self.until_us)
        return draft

    def accept(self) -> None:
        """Keep the proposed batch."""
        self._commit(self._take_draft())
        self._kept = None

    def delay(self, delay_us: int) -> None:
        """Withdraw the proposed batch. It is planned again, and everything from it on starts `delay_us` later."""
        self._take_draft()
        self._kept = None
        for beam in self._state.beams:
            # All beams, or the order of stages would change by the delay.
            beam.free_us += delay_us
        self._state.delay_us += delay_us

    def pause(self, pause: GalvoPause) -> None:
        """Withdraw the proposed batch. It is planned again with a pause after its first pulses, which stay."""
        self._take_draft()
        self._pending_pause = pause

    def _take_draft(self) -> BatchDraft:
        if self._draft is None:
            raise RuntimeError("no batch is proposed")
        draft, self._draft = self._draft, None
        return draft

    def _commit(self, draft: BatchDraft) -> None:
        self._state = draft.state
        self.skipped += draft.skipped

    def _plan_frame(self, source: int, heat: ThermalState) -> list[Round]:
        """Decide the visiting order of a frame and, if it is simultaneous, its number of interleaved rounds."""
        frame, state = self._sequence.frames[source], self._state
        requested_us = self._planner.compute_requested_us(frame.show_at_s) + state.delay_us
        free_us = [max(beam.free_us, state.begun_us, requested_us) for beam in state.beams]
        stretches = self._assignment.assign(source, np.array(free_us) * 1e-6)
        if stretches is None or source in self._visiting_orders:
            orders = tuple(self._compute_order(source, stage) for stage in range(len(self._tools)))
        else:
            for stage, (tools, beam, stretch) in enumerate(zip(self._tools, state.beams, stretches, strict=True)):
                if not self._can_repeat_order(source, stage, stretch.tolist()):
                    self._orders[stage] = tools.path.orient(stretch, beam.pixel)
            orders = tuple(self._orders[stage] for stage in range(len(self._tools)))
        # One pixel has nothing to be simultaneous with.
        if not frame.simultaneous or sum(map(len, orders)) < 2:
            return [Round(source, orders)]
        begin_us = max(free_us)
        single_pulses = {}
        for tools, order in zip(self._tools, orders, strict=True):
            for pixel in order:
                pulse = heat.solve_pulse(pixel, begin_us * 1e-6, float(frame.target_m[pixel]), tools.drive)
                if pulse is not None:
                    # The single pulse at the frame's begin is what the rounds split: it is the most that a pixel needs.
                    single_pulses[pixel] = pulse
        if not single_pulses:
            return [Round(source, orders)]
        rounds = {
            count: _list_rounds(source, orders, count, periods)
            for count in ROUND_COUNTS
            if (periods := split_pulses(single_pulses, count)) is not None
        }
        candidates = [self._evaluate_rounds(source, each, heat) for each in rounds.values()]
        deadline_us = self._planner.compute_requested_us(frame.show_at_s + frame.duration_s) + state.delay_us
        selected, single = select_schedule(candidates, deadline_us * 1e-6), candidates[0]
        self.simultaneous.append(
            SimultaneousFrame(
                source, selected.rounds, selected.simultaneity, single.simultaneity, selected.end_s - single.end_s
            )
        )
        return rounds[selected.rounds]

    def _compute_order(self, source: int, stage: int) -> list[int]:
        """Return the visiting order of a frame's pixels that belong to a stage."""
        stage_of = self._assignment.stage_of
        if source in self._visiting_orders:
            order = self._visiting_orders[source]
            given: list[int] = order[stage_of[order] == stage].tolist()
            return given
        frame, beam = self._sequence.frames[source], self._state.beams[stage]
        active = np.flatnonzero((frame.target_m > 0) & (stage_of == stage))
        # Same pixels: the same order, while the mirrors are back in time. Reversed, the pixels at the ends would get
        # two pulses in a row.
        if self._can_repeat_order(source, stage, active.tolist()):
            return self._orders[stage]
        self._orders[stage] = self._tools[stage].path.compute_order(active, beam.pixel)
        return self._orders[stage]

    def _can_repeat_order(self, source: int, stage: int, pixels: list[int]) -> bool:
        """Return whether the stage's last order has these pixels, and the mirrors return to its begin in time.

        A path that reverses would give the pixels at its ends pairs of pulses.
        """
        before, beam = self._orders.get(stage, []), self._state.beams[stage]
        if not before or sorted(before) != sorted(pixels):
            return False
        requested_us = self._planner.compute_requested_us(self._sequence.frames[source].show_at_s)
        return_us = self._tools[stage].path.compute_settling_us(beam.pixel, before[0], beam.dwell_us)
        return requested_us + self._state.delay_us - beam.free_us >= return_us

    def _evaluate_rounds(self, source: int, rounds: list[Round], heat: ThermalState) -> CandidateSchedule:
        """Plan the rounds of a frame without the limiter, on copies of the beam state and the heat."""
        trial = self._fork(rounds)
        batches, last_round_start_s = [], 0.0
        for batch in trial.run(heat.copy(), lambda proposed: proposed):
            batches.append(batch)
            if np.isfinite(batch.target_m[batch.source == source]).any() and last_round_start_s == 0.0:
                last_round_start_s = float(batch.start_s[0])
        plan = concatenate_batches(batches)
        heights_m = self._sequence.frames[source].target_m
        target_m = {pixel: float(heights_m[pixel]) for order in rounds[-1].orders for pixel in order}
        simultaneity = compute_simultaneity(heat, plan, target_m, last_round_start_s, self._on_progress)
        end_s = plan.end_s
        is_separated = len(rounds) == 1 or has_min_gaps(plan, self._scan_heads[0].pulse_gap_s)
        return CandidateSchedule(len(rounds), simultaneity, end_s, is_separated)

    def _fork(self, rounds: list[Round]) -> "Scheduler":
        """Return a scheduler that plans only `rounds` from the present state and leaves this one unchanged."""
        # A copy of references: state and steps are replaced below, a trial only reads the rest.
        fork = copy(self)
        fork._state = self._state.copy()
        fork._state.begin_order()
        fork._steps = deque(rounds)
        fork.until_us = inf
        fork.skipped = []
        return fork


def _list_steps(sequence: FrameSequence) -> Iterator[_TrainsBefore | _Frame]:
    for source, frame in enumerate(sequence.frames):
        yield _TrainsBefore(frame.show_at_s * 1e6)
        yield _Frame(source)
    yield _TrainsBefore(inf)


def _list_rounds(source: int, orders: tuple[list[int], ...], count: int, periods: PeriodsByPixel) -> list[Round]:
    """Return `count` rounds: sub-pulses of fixed width in all but the last, which brings each pixel to its height."""
    split = tuple([pixel for pixel in order if pixel in periods] for order in orders)
    return [Round(source, split, periods)] * (count - 1) + [Round(source, orders)]
