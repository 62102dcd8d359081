"""A batch under construction: planned pulses, and the state of all beams that they lead to."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from optodrive.core.types.plans import PulsePlan
from optodrive.planning.scheduler.scan_head import BeamPath


@dataclass(frozen=True)
class SkippedPulse:
    """A pulse of a frame or train that was omitted because the residual heat reaches its target.

    Or comes so near that the weakest pulse that the laser emits would miss it by more.
    """

    source: int
    pixel: int
    target_m: float


class PulseStart(NamedTuple):
    """Gate-on time of a pulse, and the settling time of the move before it, µs."""

    start_us: int
    settling_us: int


class PlannedPulse(NamedTuple):
    """One row of a plan, in whole microseconds."""

    start_us: int
    width_us: int
    power_w: float
    pixel: int
    settling_us: int
    target_m: float
    requested_start_us: int
    source: int
    stage: int


@dataclass
class BeamState:
    """State of one stage's beam, and its progress, after the pulses planned so far.

    free_us: end of the last pulse; pixel: where the mirrors stand, None while unknown
    arrival_us, dwell_us: first gate-on time on that pixel, and time spent there since
    next_train: index of the next train pulse; position: index into the current frame's visiting order
    """

    free_us: int = 0
    pixel: int | None = None
    arrival_us: int = 0
    dwell_us: int = 0
    next_train: int = 0
    position: int = 0

    def copy(self) -> "BeamState":
        """Return an independent copy."""
        return BeamState(self.free_us, self.pixel, self.arrival_us, self.dwell_us, self.next_train, self.position)


@dataclass
class PlanState:
    """State of the beams of all stages.

    begun_us: start of the last pulse of any stage: pulses are planned in order of their starts
    delay_us: total of all delays so far
    """

    beams: list[BeamState]
    begun_us: int = 0
    delay_us: int = 0

    def copy(self) -> "PlanState":
        """Return an independent copy."""
        return PlanState([beam.copy() for beam in self.beams], self.begun_us, self.delay_us)

    def begin_order(self) -> None:
        """Put every beam at the start of its visiting order."""
        for beam in self.beams:
            beam.position = 0


@dataclass
class BatchDraft:
    """Pulses planned on a copy of the state. The scheduler adopts the copy when the batch is accepted."""

    paths: tuple[BeamPath, ...]
    state: PlanState
    rows: list[PlannedPulse] = field(default_factory=list)
    skipped: list[SkippedPulse] = field(default_factory=list)

    @classmethod
    def begin(cls, paths: tuple[BeamPath, ...], state: PlanState) -> "BatchDraft":
        """Return an empty draft that starts at `state`."""
        return cls(paths, state.copy())

    def copy(self) -> "BatchDraft":
        """Return an independent copy."""
        return BatchDraft(self.paths, self.state.copy(), self.rows.copy(), self.skipped.copy())

    def compute_start(self, stage: int, pixel: int, requested_us: int) -> PulseStart:
        """Return the earliest start of a stage's pulse on `pixel` that is requested for `requested_us`."""
        state, beam = self.state, self.state.beams[stage]
        settling_us = self.paths[stage].compute_settling_us(beam.pixel, pixel, beam.dwell_us)
        # begun_us: not before the last pulse of any stage, because the limiter takes pulses in order of their starts.
        start_us = max(requested_us + state.delay_us, beam.free_us + settling_us, state.begun_us)
        return PulseStart(start_us, settling_us)

    def add(
        self,
        stage: int,
        pixel: int,
        start: PulseStart,
        width_us: int,
        power_w: float,
        requested_us: int,
        target_m: float,
        source: int,
    ) -> None:
        """Append a pulse at its earliest start, as `compute_start` returned it for the present state of the beam."""
        beam, (start_us, settling_us) = self.state.beams[stage], start
        if pixel != beam.pixel:
            # Only with a move: pulses that follow on one pixel make one long dwell, after which mirrors have settled.
            beam.arrival_us = start_us
        beam.free_us, beam.pixel = start_us + width_us, pixel
        beam.dwell_us = beam.free_us - beam.arrival_us
        self.state.begun_us = start_us
        row = PlannedPulse(start_us, width_us, power_w, pixel, settling_us, target_m, requested_us, source, stage)
        self.rows.append(row)

    def find_end_us(self) -> int:
        """Return the end of the last pulse of all beams, µs."""
        return max(beam.free_us for beam in self.state.beams)

    def sort_rows(self, first: int) -> None:
        """Put the rows from `first` on in order of their starts."""
        # Stages were drafted one after the other; the limiter needs their pulses in order.
        self.rows[first:] = sorted(self.rows[first:], key=lambda row: row.start_us)
        if self.rows:
            self.state.begun_us = max(self.state.begun_us, self.rows[-1].start_us)

    def skip(self, source: int, pixel: int, target_m: float) -> None:
        """Record a pulse that needs no energy."""
        self.skipped.append(SkippedPulse(source, pixel, target_m))

    def to_plan(self) -> PulsePlan:
        """Return the drafted pulses as a plan."""
        start_us, width_us, power_w, pixel, settling_us, target_m, requested_start_us, source, stage = zip(
            *self.rows, strict=True
        )
        index, stages = np.array(pixel, dtype=np.int64), np.array(stage, dtype=np.int64)
        x_rad, y_rad = (
            np.stack(angles_rad) for angles_rad in zip(*((p.x_rad, p.y_rad) for p in self.paths), strict=True)
        )
        return PulsePlan(
            start_s=np.array(start_us) * 1e-6,
            width_s=np.array(width_us) * 1e-6,
            x_rad=x_rad[stages, index],
            y_rad=y_rad[stages, index],
            power_w=np.array(power_w),
            pixel=index,
            settling_s=np.array(settling_us) * 1e-6,
            target_m=np.array(target_m),
            requested_start_s=np.array(requested_start_us) * 1e-6,
            source=np.array(source, dtype=np.int64),
            stage=stages,
        )
