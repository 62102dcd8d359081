"""Variants of a sequence with scaled heights, stretched times or omitted pixels."""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame, Train


def scale_sequence(sequence: FrameSequence, factor: float) -> FrameSequence:
    """Return the sequence with all heights, and the powers of pulse trains, multiplied by a factor."""
    return FrameSequence(
        tuple(replace(frame, target_m=frame.target_m * factor) for frame in sequence.frames),
        tuple(_scale_train(train, factor) for train in sequence.trains),
    )


def _scale_train(train: Train, factor: float) -> Train:
    if isinstance(train, PulseTrain):
        return replace(train, power_w=train.power_w * factor)
    peak_to_peak_m = None if train.peak_to_peak_m is None else train.peak_to_peak_m * factor
    return replace(train, target_m=train.target_m * factor, peak_to_peak_m=peak_to_peak_m)


def stretch_sequence(sequence: FrameSequence, time_factor: float) -> FrameSequence:
    """Return the sequence with all times multiplied by a factor. The pulse widths of pulse trains stay."""
    return FrameSequence(
        tuple(
            replace(frame, show_at_s=frame.show_at_s * time_factor, duration_s=frame.duration_s * time_factor)
            for frame in sequence.frames
        ),
        tuple(_stretch_train(train, time_factor) for train in sequence.trains),
    )


def _stretch_train(train: Train, time_factor: float) -> Train:
    start_s, duration_s = train.start_s * time_factor, train.duration_s * time_factor
    if isinstance(train, HeightTrain):
        return replace(train, start_s=start_s, duration_s=duration_s, period_s=train.period_s * time_factor)
    # Stretch the period instead of the gap alone, so that the pulses of two trains do not overlap.
    gap_s = (train.pulse_width_s + train.gap_s) * time_factor - train.pulse_width_s
    return replace(train, start_s=start_s, duration_s=duration_s, gap_s=gap_s)


def omit_pixels(sequence: FrameSequence, omitted: Mapping[int, Collection[int]]) -> FrameSequence:
    """Return the sequence without some pixels of its frames and some of its trains.

    omitted: pixels by source; sources number the frames, then the trains. A train is omitted whole.
    """
    return FrameSequence(
        tuple(_omit_from_frame(frame, omitted.get(source, ())) for source, frame in enumerate(sequence.frames)),
        tuple(train for k, train in enumerate(sequence.trains) if len(sequence.frames) + k not in omitted),
    )


def _omit_from_frame(frame: TactileFrame, pixels: Collection[int]) -> TactileFrame:
    if not pixels:
        return frame
    target_m = frame.target_m.copy()
    target_m[np.array(sorted(pixels))] = 0.0
    return replace(frame, target_m=target_m)
