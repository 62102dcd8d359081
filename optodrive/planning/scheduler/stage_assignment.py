"""Which stage draws which pixel within a plan: all beams are to end each frame together, each on a short path.

Pixels that recur in a plan are shared before it begins where the whole of it then ends clearly earlier. The others that
a frame adds are cut into stretches of one path over them, one per stage: the stage that is ahead gets the longest.
"""

from heapq import heapify, heapreplace
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame, Train
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.scheduler.scan_head import ScanHead
from optodrive.planning.scheduler.stage_balance import FrameLoads, balance, find_drawing_s
from optodrive.planning.scheduler.visiting_path import compute_visiting_order

NOBODY = -1
SHARES = np.linspace(0.0, 1.0, 41)
"""Shares of a pixel's largest displacement at which widths are tabulated."""
BALANCED_MAX = 2_000_000
"""Frames times recurring pixels that are shared before a plan begins; later frames keep what the first ones decide."""
GAIN_ENOUGH = 0.01
"""Share of the time for less of which recurring pixels are not assigned before a plan begins: estimates are off by
more, and frame by frame the plan corrects them."""
COOLING_S = np.concatenate([[0.0], np.geomspace(1e-3, 30.0, 60)])
"""Times after a pulse at which the displacement that is left is tabulated, s."""
TRAIN_SHARE = 0.5
"""Share of the beam time that a train takes, as half duty does."""


class PulseWidthEstimate(NamedTuple):
    """Width of a pulse by its target: max_m [p], and widths on a cold pixel at SHARES of it, s.

    saved: share of the width that the same target does not need COOLING_S after a pulse for it
    """

    max_m: FloatArray
    widths_s: FloatArray
    saved: FloatArray

    @classmethod
    def from_cold(cls, cold: ThermalState, max_m: FloatArray, drive: DriveRange) -> "PulseWidthEstimate":
        """Tabulate the tallest pixel. Others are alike at equal shares of their largest displacement."""
        # One pixel stands for all: widths are alike at equal shares of the largest displacement, and only compared.
        pixel = int(np.argmax(max_m))
        widths_s = [0.0]
        for share in SHARES[1:]:
            pulse = cold.solve_pulse(pixel, 0.0, float(share * max_m[pixel]), drive)
            widths_s.append(0.0 if pulse is None else (pulse[0] - 1 + pulse[1]) * drive.period_s)
        return cls(max_m, np.array(widths_s), _tabulate_saved(cold, pixel, 0.5 * float(max_m[pixel]), drive))

    def compute_frames_s(self, target_m: FloatArray, show_at_s: FloatArray, stages: int, step_s: float) -> FloatArray:
        """Return the estimated beam time of frames [f, p], 0 where one lights nothing. Warm pixels need less.

        show_at_s: begin of each frame; step_s: time of a move
        """
        beam_s = np.zeros_like(target_m)
        before_m, drawn_at_s, at_s = np.zeros(target_m.shape[1]), np.full(target_m.shape[1], -np.inf), 0.0
        for frame, heights_m in enumerate(target_m):
            at_s = max(at_s, float(show_at_s[frame]))
            is_drawn = heights_m > 0
            cold_s = self.compute_s(np.where(is_drawn, heights_m, 0.0))
            saved = np.interp(at_s - drawn_at_s, COOLING_S, self.saved)
            saved_s = saved * self.compute_s(np.minimum(before_m, np.where(is_drawn, heights_m, 0.0)))
            beam_s[frame] = np.where(is_drawn, cold_s - saved_s + step_s, 0.0)
            before_m, drawn_at_s = np.where(is_drawn, heights_m, before_m), np.where(is_drawn, at_s, drawn_at_s)
            at_s += beam_s[frame].sum() / stages
        return beam_s

    def compute_s(self, target_m: FloatArray) -> FloatArray:
        """Return the estimated width for targets [p], s."""
        shares = np.divide(target_m, self.max_m, out=np.zeros_like(target_m), where=self.max_m > 0)
        return np.interp(shares, SHARES, self.widths_s)


def _tabulate_saved(cold: ThermalState, pixel: int, target_m: float, drive: DriveRange) -> FloatArray:
    """Return the share of a pulse's width that the next one for the same target saves by the heat that is left."""
    periods, duty = cold.solve_pulse(pixel, 0.0, target_m, drive) or (0, 0.0)
    end_s, power_w = periods * drive.period_s, duty * drive.max_power_w
    warm = cold.copy()
    warm.apply_pulses(np.array([pixel]), np.zeros(1), np.array([end_s]), np.array([power_w]))
    saved = []
    for wait_s in COOLING_S:
        pulse = warm.solve_pulse(pixel, end_s + float(wait_s), target_m, drive)
        saved.append(1.0 if pulse is None else 1.0 - (pulse[0] - 1 + pulse[1]) / (periods - 1 + duty))
    return np.array(saved)


class StageAssignment:
    """The stage of each pixel, decided frame by frame as the plan reaches them.

    The stages of the pixels of trains and of recurring pixels are decided before.

    stage_of: [p] stage of each pixel, NOBODY while it has none
    """

    def __init__(
        self,
        sequence: FrameSequence,
        scan_heads: tuple[ScanHead, ...],
        reach: BoolArray,
        pulse_widths: PulseWidthEstimate | None,
    ) -> None:
        """Assign trains and recurring pixels.

        reach: [k, p] whether a stage reaches a pixel; pulse_widths: None with one stage
        """
        self._sequence, self._first, self._reach, self._pulse_widths = sequence, scan_heads[0], reach, pulse_widths
        first = self._first
        self._step_s = first.settling.settling_us(first.settling.pitch_rad, 0.0) * 1e-6 if pulse_widths else 0.0
        self.stage_of = (
            _assign_trains(sequence.trains, reach) if pulse_widths else np.zeros(reach.shape[1], dtype=np.int64)
        )
        if pulse_widths:
            self._assign_recurring(pulse_widths)

    def _assign_recurring(self, pulse_widths: PulseWidthEstimate) -> None:
        """Assign the pixels that several frames light over the whole plan, if it is then drawn in clearly less time."""
        # Bounded work; pixels of later frames recur in these, or are assigned when the plan reaches them.
        frames = self._sequence.frames[: max(2, BALANCED_MAX // len(self.stage_of))]
        target_m = np.array([frame.target_m for frame in frames]).reshape(len(frames), len(self.stage_of))
        is_drawn, is_free, stages = target_m > 0, self.stage_of == NOBODY, len(self._reach)
        drawing = int(np.count_nonzero(self._reach.any(axis=1)))
        recurring = np.flatnonzero((np.count_nonzero(is_drawn, axis=0) > 1) & is_free)
        if not len(recurring):
            return
        show_at_s = np.array([frame.show_at_s for frame in frames])
        cost_s = pulse_widths.compute_frames_s(target_m, show_at_s, drawing, self._step_s)
        overlap_s = np.append(0.0, cost_s.sum(axis=1) / np.maximum(np.count_nonzero(is_drawn, axis=1), 1))[:-1]
        loads = FrameLoads(np.zeros((len(frames), stages)), np.zeros(len(frames)), show_at_s, overlap_s)
        self._assign_by_frame(loads, cost_s, is_carried=True)
        by_frame_s = find_drawing_s(loads)
        # Already near the best that any share can do: light divided by the stages.
        if by_frame_s <= (1.0 + GAIN_ENOUGH) * loads.loads_s.sum() / drawing:
            return
        stage = self._assign_by_frame(loads, cost_s, is_carried=False)
        # Pixels that occur once level what the recurring ones leave uneven, so they stay free.
        is_free[recurring] = False
        for frame, each_s in enumerate(np.where(is_free, cost_s, 0.0)):
            loads.loads_s[frame] -= np.bincount(stage, each_s, stages)
            loads.shared_s[frame] = each_s.sum()
        share = stage[recurring]
        balance(loads, cost_s[:, recurring], share, self._reach[:, recurring])
        # The model knows neither paths nor pauses: below 1 % its choice was worse than none, measured with random dots.
        if by_frame_s > (1.0 + GAIN_ENOUGH) * find_drawing_s(loads):
            self.stage_of[recurring] = share

    def _assign_by_frame(self, loads: FrameLoads, cost_s: FloatArray, is_carried: bool) -> IntArray:
        """Assign frame by frame in the model of the plan. Return the stages [p]. This modifies loads.loads_s.

        cost_s: [f, p] beam time of each pixel in each frame; is_carried: whether a frame levels what the one before
        left uneven, as in the plan, or each begins level
        """
        given, free_s = self.stage_of.copy(), np.zeros(len(self._reach))
        for source, (pixels_s, loads_s) in enumerate(zip(cost_s, loads.loads_s, strict=True)):
            begin_s = max(loads.show_at_s[source], free_s.max() - loads.overlap_s[source])
            free_s = np.maximum(free_s, begin_s) if is_carried else np.zeros(len(free_s))
            self.assign(source, free_s)
            frame, active = self._sequence.frames[source], np.flatnonzero(pixels_s)
            loads_s[:] = _compute_train_beam_s(self._sequence.trains, frame, self.stage_of, len(free_s))
            loads_s += np.bincount(self.stage_of[active], pixels_s[active], len(free_s))
            free_s = free_s + loads_s
        stage, self.stage_of = np.maximum(self.stage_of, 0), given  # pixels that no frame lights have no stage
        return stage

    def _order_path(self, pixels: IntArray) -> IntArray:
        """Return pixels in the order of a short path over them."""
        layout, moves = self._first.layout, self._first.moves
        return compute_visiting_order(pixels, layout.row, layout.column, moves.x_rad, moves.y_rad)

    def assign(self, source: int, free_s: FloatArray) -> tuple[IntArray, ...] | None:
        """Assign the pixels of a frame that have no stage: all stages, free from free_s [k] on, are to end together.

        Returns each stage's stretch of a short path over the frame; None if some pixels had a stage, or with one stage.
        """
        if self._pulse_widths is None:
            return None
        frame = self._sequence.frames[source]
        active = np.flatnonzero(frame.target_m > 0)
        cost_s = self._pulse_widths.compute_s(frame.target_m)[active] + self._step_s
        known = self.stage_of[active] != NOBODY
        busy_s = free_s + _compute_train_beam_s(self._sequence.trains, frame, self.stage_of, len(free_s))
        busy_s += np.bincount(self.stage_of[active[known]], cost_s[known], len(free_s))
        path = self._order_path(active[~known])
        stages = self.stage_of[path] = _cut(cost_s[np.searchsorted(active, path)], busy_s, self._reach[:, path])
        # Stretches of one path only where all pixels are new: with assigned ones between, each stage finds its own
        # path.
        return None if known.any() else tuple(path[stages == stage] for stage in range(len(free_s)))


def _cut(cost_s: FloatArray, free_s: FloatArray, reach: BoolArray) -> IntArray:
    """Cut pixels [n] of a path into one stretch per stage [k], so that all end together. Return their stages.

    cost_s: beam time of each pixel; free_s: time from which each stage is free; reach: [k, n]
    """
    if not len(cost_s):
        return np.zeros(0, dtype=np.int64)
    drawing = np.flatnonzero(reach.any(axis=1))
    # How much each stage gets, by longest time first; which pixels, by the path, so that moves stay short.
    bounds_s = np.cumsum(_share(cost_s, free_s[drawing]))
    nearest = drawing[np.minimum(np.searchsorted(bounds_s, np.cumsum(cost_s) - 0.5 * cost_s), len(drawing) - 1)]
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


def _compute_train_beam_s(
    trains: tuple[Train, ...], frame: TactileFrame, stage_of: IntArray, stages: int
) -> FloatArray:
    """Return the beam time that trains take on each stage during a frame, [k]."""
    busy_s = np.zeros(stages)
    for train in trains:
        end_s = min(frame.show_at_s + frame.duration_s, train.start_s + train.duration_s)
        busy_s[stage_of[train.pixel]] += TRAIN_SHARE * max(0.0, end_s - max(frame.show_at_s, train.start_s))
    return busy_s
