"""Parse one frame of a running stream, from JSON text or from two bytes per pixel."""

from dataclasses import replace

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.planning.stimuli.binary_frame import FRAME_NUMBER_MAX, HEADER, HEIGHT_UNIT_M, MAGIC
from optodrive.planning.stimuli.frame_json import parse_targets_m
from optodrive.planning.stimuli.json_values import decode_json, require_object

FRAME_DURATION_S = 3600.0
"""Nominal duration of a streamed frame, s; the next frame, or one complete drawing, ends it earlier."""


def parse_live_frame(message: str | bytes, expected_number: int, pixel_count: int) -> tuple[int, FrameSequence]:
    """Return a frame's number and its sequence. JSON without a number gets the expected one.

    Text: {"frame": 7, "target_um": …} with target_um as in FRAMES.json. Bytes, little-endian: "ODF1", u32 number,
    then a u16 per pixel, in 0.1 µm. Raises InputError (bad_json, bad_frame, bad_target, unknown_pixel, …).
    """
    if isinstance(message, bytes):
        number, target_m = _parse_binary(message, pixel_count)
    else:
        number, target_m = _parse_text(message, expected_number, pixel_count)
    return number, FrameSequence((TactileFrame(str(number), 0.0, FRAME_DURATION_S, target_m),))


def _parse_binary(message: bytes, pixel_count: int) -> tuple[int, FloatArray]:
    size = HEADER.size + 2 * pixel_count
    if message[:4] != MAGIC:
        raise InputError("frame", message[:4], f"bytes that begin with {MAGIC.decode()}", code="bad_frame")
    if len(message) != size:
        expected = f"{size} bytes: {HEADER.size}, and 2 for each of {pixel_count} pixels"
        raise InputError("frame", f"{len(message)} bytes", expected, code="bad_frame")
    number: int = HEADER.unpack_from(message)[1]
    return number, np.frombuffer(message, dtype="<u2", offset=HEADER.size) * HEIGHT_UNIT_M


def _parse_text(message: str, expected_number: int, pixel_count: int) -> tuple[int, FloatArray]:
    table = require_object(decode_json(message, "frame"), "frame", ("frame", "target_um"), ("target_um",))
    number = table.get("frame", expected_number)
    if type(number) is not int or not 0 <= number <= FRAME_NUMBER_MAX:
        raise InputError("frame.frame", number, f"a whole number, 0…{FRAME_NUMBER_MAX}", code="bad_frame")
    pixel_by_name = {str(pixel): pixel for pixel in range(pixel_count)}
    return number, parse_targets_m(table["target_um"], "frame.target_um", pixel_by_name)


def can_split(sequence: FrameSequence) -> bool:
    """Return whether a sequence is one frame whose pixels may be raised one after the other."""
    return len(sequence.frames) == 1 and not sequence.trains and not sequence.frames[0].simultaneous


def stale_pixels_first(sequence: FrameSequence, refreshed: BoolArray) -> FrameSequence:
    """Split a stream's frame in two: first the pixels not yet refreshed in this refresh cycle, then the others.

    Every pixel thus gets its turn at any frame rate. refreshed: [p], refreshed in this cycle.
    """
    (frame,) = sequence.frames
    parts = [np.where(part, frame.target_m, 0.0) for part in (~refreshed, refreshed)]
    return FrameSequence(
        tuple(TactileFrame(frame.frame_id, 0.0, frame.duration_s, part) for part in parts if part.any()) or (frame,)
    )


def delay_frames(sequence: FrameSequence, delay_s: float) -> FrameSequence:
    """Return a sequence whose frames and trains begin later by a time, s."""
    return FrameSequence(
        tuple(replace(frame, show_at_s=frame.show_at_s + delay_s) for frame in sequence.frames),
        tuple(replace(train, start_s=train.start_s + delay_s) for train in sequence.trains),
    )
