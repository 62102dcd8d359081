"""Which stage draws which pixel within a plan: all beams are to end each frame together, each on a short path.

The pixels that a frame adds are cut into stretches of one path over them, one per stage: the stage that is ahead gets
the longest.
"""

from heapq import heapify, heapreplace
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame, Train
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.scheduler.scan_head import ScanHead
from optodrive.planning.scheduler.visiting_path import compute_visiting_order

NOBODY = -1
SHARES = np.linspace(0.0, 1.0, 41)
"""Shares of a pixel's largest displacement at which widths are tabulated."""
TRAIN_SHARE = 0.5
"""Share of the beam time that a train takes, as half duty does."""


class LightEstimate(NamedTuple):
    """Width of a pulse on a cold pixel by its target: max_m [p], and widths at SHARES of it, s."""

    max_m: FloatArray
    widths_s: FloatArray

    @classmethod
    def from_cold(cls, cold: ThermalState, max_m: FloatArray, drive: DriveRange) -> "LightEstimate":
        """Tabulate the widths of the tallest pixel; those of others are alike at equal shares of their largest."""
        pixel = int(np.argmax(max_m))
        widths_s = [0.0]
        for share in SHARES[1:]:
            pulse = cold.solve_pulse(pixel, 0.0, float(share * max_m[pixel]), drive)
            widths_s.append(0.0 if pulse is None else (pulse[0] - 1 + pulse[1]) * drive.period_s)
        return cls(max_m, np.array(widths_s))

    def compute_s(self, target_m: FloatArray) -> FloatArray:
        """Return the estimated width for targets [p], s."""
        shares = np.divide(target_m, self.max_m, out=np.zeros_like(target_m), where=self.max_m > 0)
        return np.interp(shares, SHARES, self.widths_s)


class StageAssignment:
    """The stage of each pixel, decided frame by frame as the plan reaches them, and for its trains before.

    stage_of: [p] stage of each pixel, NOBODY while it has none
    """

    def __init__(
        self, sequence: FrameSequence, scan_heads: tuple[ScanHead, ...], reach: BoolArray, light: LightEstimate | None
    ) -> None:
        """Assign the trains; reach: [k, p] whether a stage's beam reaches a pixel; light: None with one stage."""
        self._sequence, self._first, self._reach, self._light = sequence, scan_heads[0], reach, light
        first = scan_heads[0]
        self._step_s = first.settling.settling_us(first.settling.pitch_rad, 0.0) * 1e-6 if light else 0.0
        self.stage_of = _assign_trains(sequence.trains, reach) if light else np.zeros(reach.shape[1], dtype=np.int64)

    def assign(self, source: int, free_s: FloatArray) -> tuple[IntArray, ...] | None:
        """Assign the pixels of a frame that have no stage: all stages, free from free_s [k] on, are to end together.

        Returns each stage's stretch of a short path over the frame; None if some pixels had a stage, or with one stage.
        """
        if self._light is None:
            return None
        frame, layout, moves = self._sequence.frames[source], self._first.layout, self._first.moves
        active = np.flatnonzero(frame.target_m > 0)
        cost_s = self._light.compute_s(frame.target_m)[active] + self._step_s
        known = self.stage_of[active] != NOBODY
        busy_s = free_s + _compute_train_light_s(self._sequence.trains, frame, self.stage_of, len(free_s))
        busy_s += np.bincount(self.stage_of[active[known]], cost_s[known], len(free_s))
        path = compute_visiting_order(active[~known], layout.row, layout.column, moves.x_rad, moves.y_rad)
        stages = self.stage_of[path] = _cut(cost_s[np.searchsorted(active, path)], busy_s, self._reach[:, path])
        return None if known.any() else tuple(path[stages == stage] for stage in range(len(free_s)))


def _cut(cost_s: FloatArray, free_s: FloatArray, reach: BoolArray) -> IntArray:
    """Cut pixels [n] of a path into one stretch per stage [k], so that all end together; return their stages.

    cost_s: beam time of each pixel; free_s: time from which each stage is free; reach: [k, n]
    """
    if not len(cost_s):
        return np.zeros(0, dtype=np.int64)
    bounds_s = np.cumsum(_share(cost_s, free_s))
    nearest = np.minimum(np.searchsorted(bounds_s, np.cumsum(cost_s) - 0.5 * cost_s), len(free_s) - 1)
    distance = np.abs(np.arange(len(free_s))[:, None] - nearest[None, :])
    stages: IntArray = np.argmin(np.where(reach, distance, len(free_s)), axis=0)
    return stages


def _share(cost_s: FloatArray, free_s: FloatArray) -> FloatArray:
    """Return the beam time that each stage gets, [k], so that no two end further apart than one pixel takes.

    Longest processing time first (Graham 1969): each pixel to the stage that is free first.
    """
    ends = [(time_s, stage) for stage, time_s in enumerate(free_s.tolist())]
    heapify(ends)
    for pixel_s in sorted(cost_s.tolist(), reverse=True):
        time_s, stage = ends[0]
        heapreplace(ends, (time_s + pixel_s, stage))
    return np.array([time_s for time_s, _ in sorted(ends, key=lambda end: end[1])]) - free_s


def _assign_trains(trains: tuple[Train, ...], reach: BoolArray) -> IntArray:
    """Return the stages of the trains' pixels, NOBODY for others: trains at the same time on different stages."""
    stage_of = np.full(reach.shape[1], NOBODY)
    spans: list[list[tuple[float, float]]] = [[] for _ in reach]
    for train in sorted(trains, key=lambda each: each.start_s):
        begin_s, end_s = train.start_s, train.start_s + train.duration_s
        if stage_of[train.pixel] == NOBODY:
            overlaps_s = [sum(max(0.0, min(end_s, end) - max(begin_s, begin)) for begin, end in each) for each in spans]
            stage_of[train.pixel] = int(np.argmin(np.where(reach[:, train.pixel], overlaps_s, np.inf)))
        spans[stage_of[train.pixel]].append((begin_s, end_s))
    return stage_of


def _compute_train_light_s(
    trains: tuple[Train, ...], frame: TactileFrame, stage_of: IntArray, stages: int
) -> FloatArray:
    """Return the beam time that trains take on each stage during a frame, [k]."""
    busy_s = np.zeros(stages)
    for train in trains:
        end_s = min(frame.show_at_s + frame.duration_s, train.start_s + train.duration_s)
        busy_s[stage_of[train.pixel]] += TRAIN_SHARE * max(0.0, end_s - max(frame.show_at_s, train.start_s))
    return busy_s
