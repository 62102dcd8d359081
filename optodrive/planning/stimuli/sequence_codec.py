"""Compact encoding of a sequence for another process of the same program."""

import pickle
import zlib

import numpy as np
from numpy.typing import NDArray

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame

ENCODED_MAX_BYTES = 60_000_000
"""Largest size of an encoded sequence, bytes."""
COMPRESSED_FROM_BYTES = 4_000_000
"""Smaller sequences are not compressed, because that takes longer than their transfer."""
SPARSE_BYTES, DENSE_BYTES = 12, 8
"""Bytes of one target with and without its pixel."""

_Target = tuple[NDArray[np.uint32] | None, FloatArray]
_Entry = tuple[str, float, float, _Target, bool, int]


def encode_sequence(sequence: FrameSequence) -> bytes:
    """Encode a sequence exactly. Raise InputError (too_many) if it exceeds ENCODED_MAX_BYTES."""
    entries: list[_Entry] = [
        (f.frame_id, f.show_at_s, f.duration_s, _encode_target(f.target_m), f.simultaneous, f.priority)
        for f in sequence.frames
    ]
    pixels = len(sequence.frames[0].target_m) if sequence.frames else 0
    body = pickle.dumps((pixels, entries, sequence.trains), pickle.HIGHEST_PROTOCOL)
    is_compressed = len(body) >= COMPRESSED_FROM_BYTES
    if is_compressed:
        body = zlib.compress(body, 1)
    if len(body) > ENCODED_MAX_BYTES:
        expected = f"a sequence of at most {ENCODED_MAX_BYTES // 1_000_000} MB of targets; send it in parts"
        raise InputError("body", f"{len(body) // 1_000_000} MB", expected, code="too_many")
    return bytes([is_compressed]) + body


def decode_sequence(encoded: bytes) -> FrameSequence:
    """Decode the bytes of `encode_sequence`, which must come from a process of this program."""
    body = zlib.decompress(encoded[1:]) if encoded[0] else encoded[1:]
    entries: list[_Entry]
    pixels, entries, trains = pickle.loads(body)  # noqa: S301 - from a process of this program
    frames = (
        TactileFrame(frame_id, show_at_s, duration_s, _decode_target(pixels, target), simultaneous, priority)
        for frame_id, show_at_s, duration_s, target, simultaneous, priority in entries
    )
    return FrameSequence(tuple(frames), trains)


def _encode_target(target_m: FloatArray) -> _Target:
    driven = np.flatnonzero(target_m)
    if SPARSE_BYTES * len(driven) < DENSE_BYTES * len(target_m):
        return driven.astype(np.uint32), target_m[driven]
    return None, target_m


def _decode_target(pixels: int, target: _Target) -> FloatArray:
    driven, values_m = target
    if driven is None:
        return values_m
    target_m = np.zeros(pixels)
    target_m[driven] = values_m
    return target_m
