"""Parser of tactile frames in JSON, in order of time and with heights in µm or perceived intensities."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from optodrive.core.errors import MISSING, InputError, Unquoted
from optodrive.core.plausibility import FRAMES, guess_unit
from optodrive.core.quantity import m_to_um, um_to_m
from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.stimuli import FRAME_NUMBER_MAX, HEADER, HEIGHT_UNIT_M, MAGIC, FrameSequence, TactileFrame
from optodrive.planning.stimuli.intensity import IntensityModel
from optodrive.planning.stimuli.json_values import (
    decode_json,
    require_number,
    require_object,
    require_priority,
    require_time,
)

FRAME_TIMES = ("show_at_s", "duration_s")
"""Required keys of a frame, beside one of `TARGET_KEYS`."""
TARGET_KEYS = ("target_um", "intensity")
"""Keys that state the targets of a frame or the target of a train: exactly one of them."""
HEIGHT = FRAMES["frames.target_um"]
ID_MAX = 100
"""Largest length of a frame's identifier, characters."""
HEIGHT_MIN_UM = 0.01
"""Smallest height other than 0, µm, far below what a finger feels; smaller numbers are metres."""
OVERLAP_TOLERANCE_S = 1e-9
"""Overlap of two frames that the rounding of their times may cause, s."""


def parse_frames(
    entries: list[object], where: str, pixel_count: int, intensity_model: IntensityModel
) -> tuple[TactileFrame, ...]:
    """Parse the entries of `frames`. Raise InputError (bad_time, bad_target, bad_priority, unknown_pixel, …)."""
    pixel_by_name = {str(pixel): pixel for pixel in range(pixel_count)}
    frames: list[TactileFrame] = []
    are_by_height: list[bool] = []
    for k, entry in enumerate(entries):
        frame, by_height = _parse_frame(entry, f"{where}[{k}]", k, pixel_by_name, intensity_model)
        if frames:
            _check_order(frames[-1], frame, f"{where}[{k}]", f"frames[{k - 1}]")
        frames.append(frame)
        are_by_height.append(by_height)
    _check_heights(where, [frame for frame, by_height in zip(frames, are_by_height, strict=True) if by_height])
    return tuple(frames)


def _check_heights(where: str, frames: list[TactileFrame]) -> None:
    """Raise InputError if the highest pixel of all frames is too low for a finger by far: mm were stated for µm."""
    highest_um = max((m_to_um(float(frame.target_m.max(initial=0.0))) for frame in frames), default=0.0)
    if 0.0 < highest_um < HEIGHT.low * (1.0 - 1e-9):
        expected = f"a highest pixel of at least {HEIGHT.low:g} µm; these values are likely in mm"
        raise InputError(f"{where}: target_um", Unquoted(f"at most {highest_um:g}"), expected, code="bad_target")


def _parse_frame(
    entry: object, where: str, position: int, pixel_by_name: dict[str, int], intensity_model: IntensityModel
) -> tuple[TactileFrame, bool]:
    """Return a frame, and whether it states heights and not intensities."""
    known = ("id", *FRAME_TIMES, *TARGET_KEYS, "simultaneous", "priority")
    table = require_object(entry, where, known, FRAME_TIMES)
    expected = "a time ≥ 0 in s"
    show_at_s = require_time(table["show_at_s"], f"{where}.show_at_s", expected, "bad_time", positive=False)
    duration_s = require_time(table["duration_s"], f"{where}.duration_s", "a time > 0 in s", "bad_time", positive=True)
    frame_id = _parse_frame_id(table.get("id", f"frame-{position}"), f"{where}.id")
    target_key = select_target_key(table, where)
    place, by_height = f"{where}.{target_key}", target_key == "target_um"
    if by_height:
        target_m = parse_targets_m(table[target_key], place, pixel_by_name)
    else:
        intensity = _parse_by_pixel(
            table[target_key], place, pixel_by_name, "intensities", '{"17": 8}', _parse_intensities
        )
        target_m = intensity_model.solve_targets_m(intensity, place)
    simultaneous = _parse_simultaneous(table, f"{where}.simultaneous")
    priority = require_priority(table.get("priority", 0), f"{where}.priority")
    return TactileFrame(frame_id, show_at_s, duration_s, target_m, simultaneous, priority), by_height


def select_target_key(table: Mapping[str, object], where: str) -> str:
    """Return which of `TARGET_KEYS` a frame or train states. Raise InputError (missing_key, bad_target)."""
    stated = [key for key in TARGET_KEYS if key in table]
    if not stated:
        raise InputError(f"{where}.target_um", MISSING, "this required key, or intensity", code="missing_key")
    if len(stated) > 1:
        raise InputError(where, "target_um and intensity", "one of them", code="bad_target")
    return stated[0]


def _parse_simultaneous(table: Mapping[str, object], where: str) -> bool:
    value = table.get("simultaneous", False)
    if not isinstance(value, bool):
        raise InputError(where, value, "true or false", code="bad_json")
    return value


def _parse_frame_id(value: object, where: str) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= ID_MAX or not value.isprintable():
        raise InputError(where, value, f"1 to {ID_MAX} printable characters", code="bad_json")
    return value


def _check_order(previous: TactileFrame, frame: TactileFrame, where: str, previous_name: str) -> None:
    if frame.show_at_s < previous.show_at_s:
        expected = f"frames in order of time, and {previous_name} is shown at {previous.show_at_s:g} s"
        raise InputError(f"{where}.show_at_s", frame.show_at_s, expected, code="bad_time")
    end_s = previous.show_at_s + previous.duration_s
    if frame.show_at_s < end_s - OVERLAP_TOLERANCE_S:
        expected = f"a time ≥ {end_s:.9g} s, when {previous_name} ends"
        raise InputError(f"{where}.show_at_s", frame.show_at_s, expected, code="bad_time")


def parse_targets_m(value: object, where: str, pixel_by_name: dict[str, int]) -> FloatArray:
    """Parse heights in µm, by pixel or as a list of all, to metres [p].

    Raises InputError (bad_target, unknown_pixel).
    """
    return _parse_by_pixel(value, where, pixel_by_name, "heights", '{"17": 50}', _parse_heights_m)


def _parse_by_pixel(
    value: object,
    where: str,
    pixel_by_name: dict[str, int],
    kind: str,
    example: str,
    parse_values: Callable[[list[object], list[int] | range, str], FloatArray],
) -> FloatArray:
    """Parse an object of values by pixel, or a list of all, to [p], 0 for pixels that are not named."""
    if isinstance(value, dict):
        for key in value:
            if key not in pixel_by_name:
                raise InputError(where, key, f"a pixel, 0…{len(pixel_by_name) - 1}", code="unknown_pixel")
        pixels = [pixel_by_name[key] for key in value]
        values = np.zeros(len(pixel_by_name))
        values[pixels] = parse_values(list(value.values()), pixels, where)
        return values
    if not isinstance(value, list):
        raise InputError(where, value, f"{kind} by pixel, {example}, or a list of all", code="bad_target")
    if len(value) != len(pixel_by_name):
        expected = f"{len(pixel_by_name)} {kind}, one per pixel"
        raise InputError(where, f"a list of {len(value)}", expected, code="bad_target")
    return parse_values(value, range(len(pixel_by_name)), where)


def _parse_intensities(values: list[object], pixels: list[int] | range, where: str) -> FloatArray:
    if set(map(type, values)) <= {int, float}:
        try:
            intensities = np.array(values, dtype=np.float64)
            if bool(np.all((intensities >= 0.0) & np.isfinite(intensities))):
                return intensities
        except OverflowError:
            pass
    return np.array(
        [
            parse_intensity(value, f"{where}.{pixel}", is_zero_allowed=True)
            for pixel, value in zip(pixels, values, strict=True)
        ]
    )


def parse_intensity(value: object, where: str, *, is_zero_allowed: bool) -> float:
    """Return a perceived intensity, in units of a threshold. Raise InputError (bad_target)."""
    expected = f"an intensity {'≥' if is_zero_allowed else '>'} 0, in thresholds"
    intensity = require_number(value, where, expected, "bad_target")
    if intensity < 0 or (intensity == 0 and not is_zero_allowed):
        raise InputError(where, value, expected, code="bad_target")
    return intensity


def _parse_heights_m(values: list[object], pixels: list[int] | range, where: str) -> FloatArray:
    if set(map(type, values)) <= {int, float}:
        try:
            heights_um = np.array(values, dtype=np.float64)
            is_plausible = (heights_um >= HEIGHT_MIN_UM) & (heights_um <= HEIGHT.high)
            if bool(np.all(is_plausible | (heights_um == 0))):
                return um_to_m(heights_um)
        except OverflowError:
            pass
    for pixel, value in zip(pixels, values, strict=True):
        place, expected = f"{where}.{pixel}", "a height ≥ 0 in µm"
        height_um = require_number(value, place, expected, "bad_target")
        if height_um < 0:
            raise InputError(place, value, expected, code="bad_target")
        if 0 < height_um < HEIGHT_MIN_UM:
            expected = (
                f"0 or at least {HEIGHT_MIN_UM:g} µm; this value is likely in {guess_unit(height_um, HEIGHT) or 'm'}"
            )
            raise InputError(place, value, expected, code="bad_target")
        if height_um > HEIGHT.high:
            expected = f"at most {HEIGHT.high:.0f} µm; this value is likely in nm"
            raise InputError(place, value, expected, code="bad_target")
    raise AssertionError("no invalid height found after validation failed")


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
