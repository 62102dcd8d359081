"""What may be changed of a sequence so that it fits: lower, slower, or fewer pixels."""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from optodrive.flow import FrameSequence, TactileFrame


def scaled(sequence: FrameSequence, factor: float) -> FrameSequence:
    """All targets and all powers of trains times one factor."""
    return FrameSequence(
        tuple(replace(frame, target_m=frame.target_m * factor) for frame in sequence.frames),
        tuple(replace(train, power_w=train.power_w * factor) for train in sequence.trains),
    )


def stretched(sequence: FrameSequence, rate: float) -> FrameSequence:
    """All times times one factor: frames, trains, and each train's pulses, whose widths stay."""
    return FrameSequence(
        tuple(
            replace(frame, show_at_s=frame.show_at_s * rate, duration_s=frame.duration_s * rate)
            for frame in sequence.frames
        ),
        tuple(
            replace(
                train,
                start_s=train.start_s * rate,
                duration_s=train.duration_s * rate,
                # Start to start is stretched, not only the gap: so pulses of two trains never come to overlap.
                gap_s=(train.pulse_width_s + train.gap_s) * rate - train.pulse_width_s,
            )
            for train in sequence.trains
        ),
    )


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
