"""Plan one batch: train pulses at their times, and the pulses of a frame's round in the beam time between them.

Theory of operation

Problem. A pulse's width and power follow from the residual heat of its pixel at its start, its start from the end of
the pulse before it on the same beam and from the move to it, and the residual heat from what the limiter granted
earlier. A plan can therefore neither be computed pulse by pulse through the limiter (which checks many at once) nor as
a whole. It is planned in batches: pulses whose shape does not depend on what the limiter makes of the others.

Invariants. A batch ends before the first pulse that heats a pixel of the batch a second time by height
(`_is_heat_known`): no pulse is computed from heat that the limiter may have trimmed. The planner changes neither the
given state nor the heat; the scheduler accepts a batch, plans it again for a later time, or inserts a pause of the
mirrors, and each is the same call from the same state. Starts are whole microseconds, widths whole PWM periods. Rows of
a draft are in order of their starts, those of all stages.

Order. Trains have requested times, frames only a deadline: a train pulse goes first if the next pulse of a round would
delay it (`_is_train_due`). With several stages each has one candidate pulse, and the earliest of them is
drafted next, so that no stage runs ahead of heat that another adds (decision 41). A candidate of another stage stays
valid, because stages share no pixel; a drafted train pulse invalidates all, because it moves a beam.

Why two ways. `extend_round` is the general way and calls the thermal state once per pulse. A round without trains and
without sub-pulses on the nominal model, which is nearly every streamed frame, is planned per stage in one kernel
(`nominal_round.py`), because a frame of 1,511 pixels is due every few tens of milliseconds. Both give the same pulses,
which tests compare. Where only some rows of several stages are wanted, the kernel first plans all of them to find how
many of each stage belong to the first ones.

Decisions: 3 (trains and frames), 14 (trains by height, sub-pulses), 41 (several stages).
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.types.stimuli import FrameSequence
from optodrive.physics.nominal_display import NominalThermalState
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.scheduler.batch_draft import BatchDraft, PlanState, PulseStart
from optodrive.planning.scheduler.interleaving import PeriodsByPixel
from optodrive.planning.scheduler.nominal_round import draft_round
from optodrive.planning.scheduler.scan_head import BeamPath
from optodrive.planning.scheduler.train_pulses import TrainPulse, TrainPulses

PROGRESS_INTERVAL = 16
"""Pulses of a frame between two progress reports."""


@dataclass(frozen=True)
class Round:
    """One pulse per pixel of every stage's order.

    periods: fixed widths of sub-pulses, None for the full height
    """

    source: int
    orders: tuple[list[int], ...]
    periods: PeriodsByPixel | None = None


class StageTools(NamedTuple):
    """Path, drive range and trains from which the pulses of one stage are planned."""

    path: BeamPath
    drive: DriveRange
    trains: TrainPulses


class _FramePulse(NamedTuple):
    """The next pulse of a stage in a round."""

    pixel: int
    start: PulseStart
    width_us: int
    power_w: float
    target_m: float


class BatchPlanner:
    """Plans batches from a state of all beams, which it does not change.

    A batch ends before the first pulse whose shape depends on how much of the batch the limiter grants.
    train_batch: maximum number of train pulses in a batch between frames; on_progress: called repeatedly
    """

    def __init__(
        self,
        sequence: FrameSequence,
        stages: tuple[StageTools, ...],
        train_batch: int,
        on_progress: Callable[[], None],
    ) -> None:
        self._sequence = sequence
        self._stages = stages
        self._paths = tuple(stage.path for stage in stages)
        self._train_batch = train_batch
        self._on_progress = on_progress

    def begin(self, state: PlanState) -> BatchDraft:
        """Return an empty draft that starts at `state`."""
        return BatchDraft.begin(self._paths, state)

    def compute_requested_us(self, time_s: float) -> int:
        """Return a time of the sequence on the plan's time line, µs."""
        return self._paths[0].lead_in_us + round(time_s * 1e6)

    def plan_trains(self, state: PlanState, until_us: float, heat: ThermalState) -> BatchDraft:
        """Draft the train pulses that are requested before `until_us`."""
        draft = self.begin(state)
        while len(draft.rows) < self._train_batch:
            due = [
                stage
                for stage in range(len(self._stages))
                if (pulse := self._next_train_pulse(draft, stage)) is not None and pulse.requested_start_us < until_us
            ]
            if not due:
                break
            stage = (
                due[0]
                if len(due) == 1
                else min(due, key=lambda number: self._start_train_pulse(draft, number).start_us)
            )
            # The batch ends here: this pulse's shape depends on what the limiter grants the batch.
            if not self._is_heat_known(draft, stage):
                break
            self._draft_train_pulse(draft, stage, heat)
        return draft

    def extend_round(
        self,
        draft: BatchDraft,
        each: Round,
        heat: ThermalState,
        max_rows: int | None = None,
        until_us: float = inf,
    ) -> None:
        """Append pulses of a round: up to the next due train pulse, `max_rows` pulses or the end of the round.

        until_us: behind the first of them, append none to a beam whose last pulse ends then or later
        """
        have_trains = any(self._next_train_pulse(draft, stage) for stage in range(len(self._stages)))
        # The usual case of a stream, in one kernel without the interpreter: other threads run meanwhile.
        if isinstance(heat, NominalThermalState) and each.periods is None and not have_trains:
            max_count = None if max_rows is None else max_rows - len(draft.rows)
            self._extend_nominal_round(draft, each, heat, max_count, until_us)
            return
        rows_max, first, pulses = inf if max_rows is None else max_rows, len(draft.rows), dict[int, _FramePulse]()
        # At least one pulse: a part of a plan without any would never get on.
        while len(draft.rows) < rows_max and (len(draft.rows) == first or draft.find_end_us() < until_us):
            for stage in range(len(self._stages)):
                pulse = None if stage in pulses else self._solve_next_pulse(draft, stage, each, heat)
                if pulse is not None:
                    pulses[stage] = pulse
            if not pulses:
                return
            # sorted: of equal starts the lower stage, in every run.
            stage = min(sorted(pulses), key=lambda number: pulses[number].start.start_us)
            train_stage = self._find_due_train(draft, pulses, stage)
            if train_stage is not None:
                if not self._is_heat_known(draft, train_stage):
                    return
                self._draft_train_pulse(draft, train_stage, heat)
                if draft.rows:
                    return
                # The train's pulse moved a beam, so candidates of its stage begin elsewhere.
                pulses.clear()
                continue
            pulse = pulses.pop(stage)
            requested_us = self.compute_requested_us(self._sequence.frames[each.source].show_at_s)
            draft.add(
                stage,
                pulse.pixel,
                pulse.start,
                pulse.width_us,
                pulse.power_w,
                requested_us,
                pulse.target_m,
                each.source,
            )
            draft.state.beams[stage].position += 1

    def _extend_nominal_round(
        self, draft: BatchDraft, each: Round, heat: NominalThermalState, max_count: int | None, until_us: float
    ) -> None:
        """Append up to max_count pulses of a round without train pulses, each stage's in one kernel."""
        counts: list[int | None] = [max_count] * len(self._stages)
        if len(self._stages) > 1 and max_count is not None:
            # How many of each stage are among the first max_count is known only when all are in order.
            trial, first = draft.copy(), len(draft.rows)
            self._extend_nominal_round(trial, each, heat, None, inf)
            stages = [row.stage for row in trial.rows[first : first + max_count]]
            counts = [stages.count(stage) for stage in range(len(self._stages))]
        frame, first, begun_us = self._sequence.frames[each.source], len(draft.rows), draft.state.begun_us
        requested_us = self.compute_requested_us(frame.show_at_s)
        # begun_us of before this call: stages are planned one after the other here, and must not wait for each other.
        earliest_us = max(requested_us + draft.state.delay_us, begun_us)
        for stage, tools in enumerate(self._stages):
            self._on_progress()
            pixels = np.array(each.orders[stage][draft.state.beams[stage].position :], dtype=np.int64)
            if len(pixels):
                given = (requested_us, earliest_us, each.source, tools.drive, counts[stage], until_us)
                draft_round(draft, stage, heat, pixels, frame.target_m[pixels], *given)
        draft.sort_rows(first)

    def _solve_next_pulse(self, draft: BatchDraft, stage: int, each: Round, heat: ThermalState) -> _FramePulse | None:
        """Return the next pulse of a stage in a round, None after its last. Pixels without need of one are skipped."""
        frame, beam, drive = self._sequence.frames[each.source], draft.state.beams[stage], self._stages[stage].drive
        requested_us = self.compute_requested_us(frame.show_at_s)
        while beam.position < len(each.orders[stage]):
            pixel = each.orders[stage][beam.position]
            target_m = float(frame.target_m[pixel])
            start = draft.compute_start(stage, pixel, requested_us)
            if beam.position % PROGRESS_INTERVAL == 0:
                self._on_progress()
            if each.periods is None:
                pulse = heat.solve_pulse(pixel, start.start_us * 1e-6, target_m, drive)
            else:
                pulse, target_m = (each.periods[pixel], 1.0), float("nan")
            if pulse is not None:
                width_us = round(pulse[0] * drive.period_s * 1e6)
                return _FramePulse(pixel, start, width_us, pulse[1] * drive.max_power_w, target_m)
            # The heat that is left holds the pixel above its target; a pulse of no energy would only cost a move.
            draft.skip(each.source, pixel, target_m)
            beam.position += 1
        return None

    def _find_due_train(self, draft: BatchDraft, pulses: dict[int, _FramePulse], first: int) -> int | None:
        """Return the stage whose train pulse comes before the pulses of a round, the next of which is of stage `first`.

        Of a stage with pulses in the round, it is due if its next one would delay it.
        """
        due = []
        for stage in range(len(self._stages)):
            if self._next_train_pulse(draft, stage) is None:
                continue
            pulse = pulses.get(stage)
            if pulse is None or self._is_train_due(draft, stage, pulse):
                due.append((self._start_train_pulse(draft, stage).start_us, stage))
        if not due:
            return None
        start_us, stage = min(due)
        # Of another stage, only if it starts first: order over all stages.
        return stage if stage == first or start_us <= pulses[first].start.start_us else None

    def _next_train_pulse(self, draft: BatchDraft, stage: int) -> TrainPulse | None:
        trains, next_train = self._stages[stage].trains, draft.state.beams[stage].next_train
        return trains[next_train] if next_train < len(trains) else None

    def _start_train_pulse(self, draft: BatchDraft, stage: int) -> PulseStart:
        """Return the earliest start of the next train pulse of a stage."""
        pulse = self._stages[stage].trains[draft.state.beams[stage].next_train]
        return draft.compute_start(stage, pulse.pixel, self._paths[stage].lead_in_us + pulse.requested_start_us)

    def _draft_train_pulse(self, draft: BatchDraft, stage: int, heat: ThermalState) -> None:
        """Draft the next train pulse of a stage, or skip it if the residual heat reaches its target."""
        trains, beam = self._stages[stage].trains, draft.state.beams[stage]
        index, start = beam.next_train, self._start_train_pulse(draft, stage)
        pulse = trains[index]
        requested_us = self._paths[stage].lead_in_us + pulse.requested_start_us
        beam.next_train += 1
        if not pulse.is_by_height:
            shape, target_m = (pulse.width_us, pulse.power_w), float("nan")
            draft.add(stage, pulse.pixel, start, *shape, requested_us, target_m, pulse.source)
            return
        # Without the plan's own delay: a delayed train is not late, and keeps its pulses' room.
        late_us = start.start_us - requested_us - draft.state.delay_us
        height_shape = trains.plan_pulse(index, heat, start.start_us, late_us)
        target_m = trains.get_target_m(pulse.source)
        if height_shape is None:
            draft.skip(pulse.source, pulse.pixel, target_m)
        else:
            draft.add(stage, pulse.pixel, start, *height_shape, requested_us, target_m, pulse.source)

    def _is_heat_known(self, draft: BatchDraft, stage: int) -> bool:
        """Return whether a stage's next train pulse is independent of the drafted pulses, which may be trimmed."""
        pulse = self._next_train_pulse(draft, stage)
        return pulse is None or not pulse.is_by_height or all(row.pixel != pulse.pixel for row in draft.rows)

    def _is_train_due(self, draft: BatchDraft, stage: int, frame_pulse: _FramePulse) -> bool:
        """Return whether a pulse of a round would delay the next train pulse of its stage."""
        pulse = self._next_train_pulse(draft, stage)
        if pulse is None:
            return False
        path, end_us = self._paths[stage], frame_pulse.start.start_us + frame_pulse.width_us
        deadline_us = path.lead_in_us + pulse.requested_start_us + draft.state.delay_us
        # The frame's width as dwell: the beam will have stood there for that time when it leaves.
        return deadline_us < end_us + path.compute_settling_us(frame_pulse.pixel, pulse.pixel, frame_pulse.width_us)
