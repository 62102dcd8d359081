"""A batch under construction: planned pulses, and the beam state that they lead to."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from optodrive.core.types.plans import PulsePlan
from optodrive.planning.scheduler.scan_head import BeamPath


@dataclass(frozen=True)
class SkippedPulse:
    """A pulse of a frame or train that was omitted because the residual heat alone reaches its target."""

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


@dataclass
class BeamState:
    """State of the beam and of the plan's progress after the pulses planned so far.

    free_us: end of the last pulse; pixel: where the mirrors stand, None while unknown
    arrival_us, dwell_us: first gate-on time on that pixel, and time spent there since
    next_train: index of the next train pulse; position: index into the current frame's visiting order
    delay_us: total of all delays so far
    """

    free_us: int = 0
    pixel: int | None = None
    arrival_us: int = 0
    dwell_us: int = 0
    next_train: int = 0
    position: int = 0
    delay_us: int = 0


@dataclass
class BatchDraft:
    """Pulses planned on a copy of the beam state; the scheduler adopts the copy when the batch is accepted."""

    path: BeamPath
    beam: BeamState
    rows: list[PlannedPulse] = field(default_factory=list)
    skipped: list[SkippedPulse] = field(default_factory=list)

    @classmethod
    def begin(cls, path: BeamPath, beam: BeamState) -> "BatchDraft":
        """Return an empty draft that starts at `beam`."""
        return cls(path, replace(beam))

    def copy(self) -> "BatchDraft":
        """Return an independent copy."""
        return BatchDraft(self.path, replace(self.beam), self.rows.copy(), self.skipped.copy())

    def compute_start(self, pixel: int, requested_us: int) -> PulseStart:
        """Return the earliest start of a pulse on `pixel` that is requested for `requested_us`."""
        beam = self.beam
        settling_us = self.path.compute_settling_us(beam.pixel, pixel, beam.dwell_us)
        return PulseStart(max(requested_us + beam.delay_us, beam.free_us + settling_us), settling_us)

    def add(
        self,
        pixel: int,
        start: PulseStart,
        width_us: int,
        power_w: float,
        requested_us: int,
        target_m: float,
        source: int,
    ) -> None:
        """Append a pulse at its earliest start, as `compute_start` returned it for the present state of the beam."""
        beam, (start_us, settling_us) = self.beam, start
        if pixel != beam.pixel:
            beam.arrival_us = start_us
        beam.free_us, beam.pixel = start_us + width_us, pixel
        beam.dwell_us = beam.free_us - beam.arrival_us
        self.rows.append(PlannedPulse(start_us, width_us, power_w, pixel, settling_us, target_m, requested_us, source))

    def skip(self, source: int, pixel: int, target_m: float) -> None:
        """Record a pulse that needs no energy."""
        self.skipped.append(SkippedPulse(source, pixel, target_m))

    def to_plan(self) -> PulsePlan:
        """Return the drafted pulses as a plan."""
        start_us, width_us, power_w, pixel, settling_us, target_m, requested_start_us, source = zip(
            *self.rows, strict=True
        )
        index = np.array(pixel, dtype=np.int64)
        return PulsePlan(
            start_s=np.array(start_us) * 1e-6,
            width_s=np.array(width_us) * 1e-6,
            x_rad=self.path.x_rad[index],
            y_rad=self.path.y_rad[index],
            power_w=np.array(power_w),
            pixel=index,
            settling_s=np.array(settling_us) * 1e-6,
            target_m=np.array(target_m),
            requested_start_s=np.array(requested_start_us) * 1e-6,
            source=np.array(source, dtype=np.int64),
        )
