"""Frames and parts of trains that are left of an interrupted plan, to be planned anew.

The rows of a plan fix which stage draws what. When a stage is lost, what is left is planned anew from the request.
"""

from dataclasses import replace

import numpy as np

from optodrive.core.types.arrays import IntArray
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame, Train
from optodrive.planning.planned_sequence import PlannedSequence

DURATION_MIN_S = 1e-3
"""Duration of the rest of a frame whose time is over."""
CYCLE_ROUNDING = 0.01
"""Largest share of a train's cycle by which rounding to microseconds moves a pulse."""


def build_rest_sequence(planned: PlannedSequence, first_row: int, origin_s: float) -> tuple[FrameSequence, IntArray]:
    """Return the requests of the rows from first_row on, and the source of each in the plan's sequence.

    A frame keeps the pixels that were not drawn, a train the cycles of which nothing was; both keep their rhythm.
    origin_s: time of the plan from which the rest counts
    """
    sequence = planned.sequence
    if not first_row:
        return sequence, np.arange(len(sequence.frames) + len(sequence.trains))
    frames: dict[int, TactileFrame] = {}
    trains: dict[int, Train] = {}
    begin_s = 0.0
    for source in np.unique(planned.plan.source[first_row:]).tolist():
        if source < len(sequence.frames):
            frame = _build_frame(planned, source, first_row, origin_s)
            if frame is not None:
                begin_s = max(begin_s, frame.show_at_s)
                frames[source] = replace(frame, show_at_s=begin_s)
        else:
            train = _build_train(planned, source, first_row, origin_s)
            if train is not None:
                trains[source] = train
    sources = np.array([*frames, *trains], dtype=np.int64)
    return FrameSequence(tuple(frames.values()), tuple(trains.values())), sources


def _build_frame(planned: PlannedSequence, source: int, first_row: int, origin_s: float) -> TactileFrame | None:
    plan, frame = planned.plan, planned.sequence.frames[source]
    rows = np.flatnonzero(plan.source == source)
    done, left = rows[rows < first_row], rows[rows >= first_row]
    show_at_s = max(0.0, float(plan.start_s[left].min()) - origin_s)
    if not len(done):
        return replace(frame, show_at_s=show_at_s)
    pixels = plan.pixel[left[np.isfinite(plan.target_m[left])]]  # sub-pulses alone raise no pixel to its height
    if not len(pixels):
        return None
    target_m = np.zeros_like(frame.target_m)
    target_m[pixels] = frame.target_m[pixels]
    shown_s = max(0.0, origin_s - float(plan.start_s[done].min()))
    duration_s = max(DURATION_MIN_S, frame.duration_s - shown_s)
    return replace(frame, show_at_s=show_at_s, duration_s=duration_s, target_m=target_m)


def _build_train(planned: PlannedSequence, source: int, first_row: int, origin_s: float) -> Train | None:
    plan, train = planned.plan, planned.sequence.trains[source - len(planned.sequence.frames)]
    period_s = train.pulse_width_s + train.gap_s if isinstance(train, PulseTrain) else train.period_s
    rows = np.flatnonzero(plan.source == source)
    requested_s = plan.requested_start_s[rows] - planned.lead_in_s - train.start_s
    cycle = np.floor(requested_s / period_s + CYCLE_ROUNDING).astype(np.int64)
    is_left = (rows >= first_row) & (cycle > cycle[rows < first_row].max(initial=-1))
    if not is_left.any():
        return None
    start_s = max(0.0, float(plan.start_s[rows[is_left]].min()) - origin_s)
    return replace(train, start_s=start_s, duration_s=train.duration_s - float(cycle[is_left].min()) * period_s)
