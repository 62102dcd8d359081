"""Parser of tactile frames in JSON, in order of time and with heights in µm."""

from collections.abc import Mapping

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.plausibility import guess_unit
from optodrive.core.plausible_ranges import FRAMES
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import TactileFrame
from optodrive.core.units import m_to_um, um_to_m
from optodrive.planning.stimuli.json_values import require_number, require_object, require_priority, require_time

FRAME_QUANTITIES = ("show_at_s", "duration_s", "target_um")
"""Required keys of a frame."""
HEIGHT = FRAMES["frames.target_um"]
ID_MAX = 100
"""Largest length of a frame's identifier, characters."""
HEIGHT_MIN_UM = 0.01
"""Smallest height other than 0, µm, far below what a finger feels; smaller numbers are metres."""
OVERLAP_TOLERANCE_S = 1e-9
"""Overlap of two frames that the rounding of their times may cause, s."""


def parse_frames(entries: list[object], where: str, pixel_count: int) -> tuple[TactileFrame, ...]:
    """Parse the entries of `frames`. Raise InputError (bad_time, bad_target, bad_priority, unknown_pixel, …)."""
    pixel_by_name = {str(pixel): pixel for pixel in range(pixel_count)}
    frames: list[TactileFrame] = []
    for k, entry in enumerate(entries):
        frame = _parse_frame(entry, f"{where}[{k}]", k, pixel_by_name)
        if frames:
            _check_order(frames[-1], frame, f"{where}[{k}]", f"frames[{k - 1}]")
        frames.append(frame)
    _check_heights(where, frames)
    return tuple(frames)


def _check_heights(where: str, frames: list[TactileFrame]) -> None:
    """Raise InputError if the highest pixel of all frames is too low for a finger by far: mm were stated for µm."""
    highest_um = max((m_to_um(float(frame.target_m.max(initial=0.0))) for frame in frames), default=0.0)
    if 0.0 < highest_um < HEIGHT.low * (1.0 - 1e-9):
        expected = f"a highest pixel of at least {HEIGHT.low:g} µm; these values are likely in mm"
        raise InputError(f"{where}: target_um", Unquoted(f"at most {highest_um:g}"), expected, code="bad_target")


def _parse_frame(entry: object, where: str, position: int, pixel_by_name: dict[str, int]) -> TactileFrame:
    table = require_object(entry, where, ("id", *FRAME_QUANTITIES, "simultaneous", "priority"), FRAME_QUANTITIES)
    expected = "a time ≥ 0 in s"
    show_at_s = require_time(table["show_at_s"], f"{where}.show_at_s", expected, "bad_time", positive=False)
    duration_s = require_time(table["duration_s"], f"{where}.duration_s", "a time > 0 in s", "bad_time", positive=True)
    frame_id = _parse_frame_id(table.get("id", f"frame-{position}"), f"{where}.id")
    target_m = parse_targets_m(table["target_um"], f"{where}.target_um", pixel_by_name)
    simultaneous = _parse_simultaneous(table, f"{where}.simultaneous")
    priority = require_priority(table.get("priority", 0), f"{where}.priority")
    return TactileFrame(frame_id, show_at_s, duration_s, target_m, simultaneous, priority)


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
    if isinstance(value, dict):
        for key in value:
            if key not in pixel_by_name:
                raise InputError(where, key, f"a pixel, 0…{len(pixel_by_name) - 1}", code="unknown_pixel")
        pixels = [pixel_by_name[key] for key in value]
        target_m = np.zeros(len(pixel_by_name))
        target_m[pixels] = _parse_heights_m(list(value.values()), pixels, where)
        return target_m
    if not isinstance(value, list):
        raise InputError(where, value, 'heights by pixel, {"17": 50}, or a list of all', code="bad_target")
    if len(value) != len(pixel_by_name):
        expected = f"{len(pixel_by_name)} heights, one per pixel"
        raise InputError(where, f"a list of {len(value)}", expected, code="bad_target")
    return _parse_heights_m(value, range(len(pixel_by_name)), where)


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
