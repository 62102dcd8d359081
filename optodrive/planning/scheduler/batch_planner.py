"""Plan one batch: train pulses at their times, and the pulses of a frame's round in the beam time between them."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf

import numpy as np

from optodrive.core.types.stimuli import FrameSequence
from optodrive.physics.nominal_display import NominalThermalState
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.scheduler.batch_draft import BatchDraft, BeamState
from optodrive.planning.scheduler.interleaving import PeriodsByPixel
from optodrive.planning.scheduler.nominal_round import draft_round
from optodrive.planning.scheduler.scan_head import BeamPath
from optodrive.planning.scheduler.train_pulses import TrainPulses

PROGRESS_INTERVAL = 16
"""Pulses of a frame between two progress reports."""


@dataclass(frozen=True)
class Round:
    """One pulse per pixel of `order`; periods: fixed widths of sub-pulses, None for pulses to the full height."""

    source: int
    order: list[int]
    periods: PeriodsByPixel | None = None


class BatchPlanner:
    """Plans batches from a beam state, which it does not change.

    A batch ends before the first pulse whose shape depends on how much of the batch the limiter grants.
    train_batch: maximum number of train pulses in a batch between frames; on_progress: called repeatedly
    """

    def __init__(
        self,
        sequence: FrameSequence,
        trains: TrainPulses,
        path: BeamPath,
        drive: DriveRange,
        train_batch: int,
        on_progress: Callable[[], None],
    ) -> None:
        self._sequence = sequence
        self._trains = trains
        self._path = path
        self._drive = drive
        self._train_batch = train_batch
        self._on_progress = on_progress

    def compute_requested_us(self, time_s: float) -> int:
        """Return a time of the sequence on the plan's time line, µs."""
        return self._path.lead_in_us + round(time_s * 1e6)

    def plan_trains(self, beam: BeamState, until_us: float, heat: ThermalState) -> BatchDraft:
        """Draft the train pulses that are requested before `until_us`."""
        draft = BatchDraft.begin(self._path, beam)
        while draft.beam.next_train < len(self._trains) and len(draft.rows) < self._train_batch:
            if self._trains[draft.beam.next_train].requested_start_us >= until_us:
                break
            if not self._is_heat_known(draft):
                break
            self._draft_train_pulse(draft, heat)
        return draft

    def extend_round(self, draft: BatchDraft, each: Round, heat: ThermalState, max_rows: int | None = None) -> None:
        """Append pulses of a round: up to the next due train pulse, `max_rows` pulses or the end of the round."""
        beam = draft.beam
        frame, source, drive = self._sequence.frames[each.source], each.source, self._drive
        requested_us = self.compute_requested_us(frame.show_at_s)
        if isinstance(heat, NominalThermalState) and each.periods is None and beam.next_train >= len(self._trains):
            self._on_progress()
            pixels = np.array(each.order[beam.position :], dtype=np.int64)
            draft_round(draft, heat, pixels, frame.target_m[pixels], requested_us, source, drive, max_rows)
            return
        while draft.beam.position < len(each.order) and len(draft.rows) < (inf if max_rows is None else max_rows):
            pixel = each.order[draft.beam.position]
            target_m = float(frame.target_m[pixel])
            start = draft.compute_start(pixel, requested_us)
            if draft.beam.position % PROGRESS_INTERVAL == 0:
                self._on_progress()
            if each.periods is None:
                pulse = heat.solve_pulse(pixel, start.start_us * 1e-6, target_m, drive)
            else:
                pulse, target_m = (each.periods[pixel], 1.0), float("nan")
            if pulse is None:
                draft.skip(source, pixel, target_m)
                draft.beam.position += 1
                continue
            width_us = round(pulse[0] * drive.period_s * 1e6)
            if self._is_train_due(draft, start.start_us + width_us, pixel, width_us):
                if not self._is_heat_known(draft):
                    break
                self._draft_train_pulse(draft, heat)
                if draft.rows:
                    break
                continue
            draft.add(pixel, start, width_us, pulse[1] * drive.max_power_w, requested_us, target_m, source)
            draft.beam.position += 1

    def _draft_train_pulse(self, draft: BatchDraft, heat: ThermalState) -> None:
        """Draft the next train pulse, or skip it if the residual heat reaches its target."""
        beam, index = draft.beam, draft.beam.next_train
        pulse = self._trains[index]
        requested_us = self._path.lead_in_us + pulse.requested_start_us
        beam.next_train += 1
        start = draft.compute_start(pulse.pixel, requested_us)
        if not pulse.is_by_height:
            draft.add(pulse.pixel, start, pulse.width_us, pulse.power_w, requested_us, float("nan"), pulse.source)
            return
        shape = self._trains.plan_pulse(index, heat, start.start_us, start.start_us - requested_us - beam.delay_us)
        target_m = self._trains.get_target_m(pulse.source)
        if shape is None:
            draft.skip(pulse.source, pulse.pixel, target_m)
        else:
            draft.add(pulse.pixel, start, *shape, requested_us, target_m, pulse.source)

    def _is_heat_known(self, draft: BatchDraft) -> bool:
        """Return whether the next train pulse is independent of the drafted pulses, which the limiter may trim."""
        pulse = self._trains[draft.beam.next_train]
        return not pulse.is_by_height or all(row.pixel != pulse.pixel for row in draft.rows)

    def _is_train_due(self, draft: BatchDraft, end_us: int, pixel: int, dwell_us: int) -> bool:
        """Return whether a pulse on `pixel` that ends at `end_us` would delay the next train pulse."""
        if draft.beam.next_train >= len(self._trains):
            return False
        pulse = self._trains[draft.beam.next_train]
        deadline_us = self._path.lead_in_us + pulse.requested_start_us + draft.beam.delay_us
        return deadline_us < end_us + self._path.compute_settling_us(pixel, pulse.pixel, dwell_us)
