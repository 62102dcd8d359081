"""What may be changed of a sequence so that it fits: lower, slower, or fewer pixels."""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame, Train


def scaled(sequence: FrameSequence, factor: float) -> FrameSequence:
    """All heights, and the powers of trains by pulse, times one factor."""
    return FrameSequence(
        tuple(replace(frame, target_m=frame.target_m * factor) for frame in sequence.frames),
        tuple(_scaled(train, factor) for train in sequence.trains),
    )


def _scaled(train: Train, factor: float) -> Train:
    if isinstance(train, PulseTrain):
        return replace(train, power_w=train.power_w * factor)
    swing_m = None if train.peak_to_peak_m is None else train.peak_to_peak_m * factor
    return replace(train, target_m=train.target_m * factor, peak_to_peak_m=swing_m)


def stretched(sequence: FrameSequence, rate: float) -> FrameSequence:
    """All times times one factor: frames, trains, and each train's pulses, whose widths stay."""
    return FrameSequence(
        tuple(
            replace(frame, show_at_s=frame.show_at_s * rate, duration_s=frame.duration_s * rate)
            for frame in sequence.frames
        ),
        tuple(_stretched(train, rate) for train in sequence.trains),
    )


def _stretched(train: Train, rate: float) -> Train:
    start_s, duration_s = train.start_s * rate, train.duration_s * rate
    if isinstance(train, HeightTrain):
        return replace(train, start_s=start_s, duration_s=duration_s, period_s=train.period_s * rate)
    # Start to start is stretched, not only the gap: so pulses of two trains never come to overlap.
    gap_s = (train.pulse_width_s + train.gap_s) * rate - train.pulse_width_s
    return replace(train, start_s=start_s, duration_s=duration_s, gap_s=gap_s)


def without(sequence: FrameSequence, left_out: Mapping[int, Collection[int]]) -> FrameSequence:
    """A sequence without some pixels of its frames and some of its trains.

    left_out: pixels by source, the index of a frame, or of a train counted on from the frames; a train goes whole.
    """
    return FrameSequence(
        tuple(_without(frame, left_out.get(source, ())) for source, frame in enumerate(sequence.frames)),
        tuple(train for k, train in enumerate(sequence.trains) if len(sequence.frames) + k not in left_out),
    )


def _without(frame: TactileFrame, pixels: Collection[int]) -> TactileFrame:
    if not pixels:
        return frame
    target_m = frame.target_m.copy()
    target_m[np.array(sorted(pixels))] = 0.0
    return replace(frame, target_m=target_m)
