"""Reader, validator and writer of FRAMES.json, which is also the body of a plan request."""

import pickle
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from optodrive.core.errors import InputError, build_nothing_raised_error
from optodrive.core.files import read_bounded
from optodrive.core.quantity import m_to_um
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame, Train
from optodrive.device.config import Config, build_pixel_layout
from optodrive.planning.stimuli.frame_json import parse_frames
from optodrive.planning.stimuli.intensity import IntensityModel
from optodrive.planning.stimuli.json_values import Labels, decode_json, parse_labels, require_list, require_object
from optodrive.planning.stimuli.train_json import check_trains, parse_train, train_to_json, validate_train

FRAMES_MAX = 10_000
"""Largest number of frames of a sequence."""
TRAINS_MAX = 10_000
"""Largest number of trains of a sequence."""
TARGETS_MAX = 20_000_000
"""Largest number of frames × pixels of a sequence: 160 MB of targets."""


def load_sequence(path: str | Path, config: Config) -> FrameSequence:
    """Read FRAMES.json. Raise InputError as `parse_sequence`, or if the file cannot be read."""
    return parse_sequence(read_bounded(Path(path)), config, Path(path).name)


def parse_sequence(body: object, config: Config, where: str) -> FrameSequence:
    """Parse a sequence for a display from JSON text or decoded JSON. `where` names the source in errors.

    Raises InputError with the place, and a code: bad_json, unknown_key, missing_key, unknown_pixel, bad_target,
    bad_time, bad_train, bad_priority, overlapping_trains, bad_label, too_many, raises_nothing.
    """
    return parse_request(body, config, where)[0]


def parse_request(body: object, config: Config, where: str) -> tuple[FrameSequence, Labels]:
    """Parse a sequence and its labels. Raise InputError as `parse_sequence`."""
    decoded = decode_json(body, where) if isinstance(body, bytes | str) else body
    table = require_object(decoded, where, ("frames", "trains", "labels"), ())
    labels = parse_labels(table.get("labels", {}), f"{where}: labels")
    pixel_count = len(build_pixel_layout(config.display))
    frame_list = require_list(table.get("frames", []), f"{where}: frames", _compute_frames_max(pixel_count))
    train_list = require_list(table.get("trains", []), f"{where}: trains", TRAINS_MAX)
    if not frame_list and not train_list:
        raise InputError(where, "neither frames nor trains", "at least one of them", code="bad_json")
    intensity_model = IntensityModel(config)
    sequence = FrameSequence(
        frames=parse_frames(frame_list, f"{where}: frames", pixel_count, intensity_model),
        trains=_parse_trains(train_list, f"{where}: trains", config, pixel_count, intensity_model),
    )
    if raises_nothing(sequence):
        reason = "every target is 0"
        raise build_nothing_raised_error(f"{where}: frames", reason, "a frame with a height above 0, or a train")
    return sequence, labels


def raises_nothing(sequence: FrameSequence) -> bool:
    """Return whether a sequence has no train, and frames without a target above 0."""
    return not sequence.trains and not any(frame.target_m.any() for frame in sequence.frames)


def validate_sequence(sequence: FrameSequence, where: str, config: Config) -> FrameSequence:
    """Return a pattern's sequence if it meets the bounds of a file. Raise InputError (too_many, bad_train, …)."""
    frames_max = _compute_frames_max(len(build_pixel_layout(config.display)))
    if len(sequence.frames) > frames_max:
        raise InputError(f"{where}: frames", len(sequence.frames), f"at most {frames_max}", code="too_many")
    trains = [validate_train(train, f"{where}: trains[{k}]", config) for k, train in enumerate(sequence.trains)]
    check_trains(trains, f"{where}: trains", config)
    return FrameSequence(sequence.frames, tuple(trains))


def _compute_frames_max(pixel_count: int) -> int:
    return min(FRAMES_MAX, TARGETS_MAX // pixel_count)


def sequence_to_json(sequence: FrameSequence) -> dict[str, object]:
    """Return a sequence in the form of FRAMES.json.

    Heights are rounded to 1e-9 µm, so that parsing restores the numbers. An intensity is written as the height that it
    was converted to.
    """
    return {
        "frames": [_frame_to_json(frame) for frame in sequence.frames],
        "trains": [train_to_json(train) | _priority_to_json(train) for train in sequence.trains],
    }


def _frame_to_json(frame: TactileFrame) -> dict[str, object]:
    driven = np.flatnonzero(frame.target_m)
    simultaneous = {"simultaneous": True} if frame.simultaneous else {}
    return (
        simultaneous
        | {
            "id": frame.frame_id,
            "show_at_s": frame.show_at_s,
            "duration_s": frame.duration_s,
            "target_um": {str(pixel): round(m_to_um(float(frame.target_m[pixel])), 9) for pixel in driven},
        }
        | _priority_to_json(frame)
    )


def _priority_to_json(item: TactileFrame | Train) -> dict[str, object]:
    return {"priority": item.priority} if item.priority else {}


def _parse_trains(
    entries: list[object], where: str, config: Config, pixel_count: int, intensity_model: IntensityModel
) -> tuple[Train, ...]:
    trains = tuple(
        parse_train(entry, f"{where}[{k}]", config, pixel_count, intensity_model) for k, entry in enumerate(entries)
    )
    check_trains(trains, where, config)
    return trains


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
