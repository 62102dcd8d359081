"""Parse pulse trains and height trains from JSON, and validate them for the beams of a display."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.plausibility import FRAMES, describe_likely_unit, guess_unit
from optodrive.core.quantity import m_to_um, um_to_m
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.stimuli import HeightTrain, PulseTrain, Train
from optodrive.device.config import Config
from optodrive.planning.stimuli.frame_json import TARGET_KEYS, parse_intensity, select_target_key
from optodrive.planning.stimuli.intensity import IntensityModel
from optodrive.planning.stimuli.json_values import require_number, require_object, require_priority, require_time

PULSE_TRAIN_KEYS = ("pixel", "start_s", "duration_s", "pulse_width_s", "gap_s", "power_w")
HEIGHT_TRAIN_KEYS = ("pixel", "start_s", "duration_s", "period_s")
"""Required keys of a height train, beside one of `TARGET_KEYS`."""
HEIGHT_TRAIN_TARGETS = (*TARGET_KEYS, "peak_to_peak_um")
HEIGHT_ONLY_KEYS = frozenset({"period_s", *HEIGHT_TRAIN_TARGETS})
"""Keys that only a height train has."""
PLAUSIBLE = FRAMES
LONG_INTERVAL_S = 1.0
"""Intervals from here on, in a shorter train, are compared with ms."""
PULSES_MAX = 2_000_000
"""Largest number of pulses of all trains."""
HEIGHT_PULSES_MAX = 100_000
"""Largest number of pulses of all height trains, which are planned one by one with the limiter's thermal state."""
OVERLAP_TOLERANCE_S = 1e-9
"""Overlap of two pulses that the rounding of their times may cause, s."""

PWM_TOLERANCE_PERIODS = 0.01
"""Largest deviation of a width from whole PWM periods, in periods; the width is rounded to whole periods."""


def parse_train(value: object, where: str, config: Config, pixel_count: int, intensity_model: IntensityModel) -> Train:
    """Parse one entry of `trains` as a pulse train or a height train, by its keys.

    Raises InputError (bad_train, bad_time, bad_target, bad_priority, unknown_pixel, unknown_key, missing_key).
    """
    if isinstance(value, dict) and not HEIGHT_ONLY_KEYS.isdisjoint(value):
        return _parse_height_train(value, where, config, pixel_count, intensity_model)
    table = require_object(value, where, (*PULSE_TRAIN_KEYS, "priority"), PULSE_TRAIN_KEYS)
    pixel, start_s, duration_s = _parse_pixel_and_time(table, where, pixel_count)
    gap_s = require_time(table["gap_s"], f"{where}.gap_s", "a gap ≥ 0 in s", "bad_train", positive=False)
    width_s = require_number(table["pulse_width_s"], f"{where}.pulse_width_s", "a width > 0 in s", "bad_train")
    power_w = require_number(table["power_w"], f"{where}.power_w", "a power > 0 in W", "bad_train")
    priority = require_priority(table.get("priority", 0), f"{where}.priority")
    return validate_train(PulseTrain(pixel, start_s, duration_s, width_s, gap_s, power_w, priority), where, config)


def _parse_pixel_and_time(table: Mapping[str, object], where: str, pixel_count: int) -> tuple[int, float, float]:
    pixel = table["pixel"]
    if type(pixel) is not int or not 0 <= pixel < pixel_count:
        raise InputError(f"{where}.pixel", pixel, f"a pixel, 0…{pixel_count - 1}", code="unknown_pixel")
    start_s = require_time(table["start_s"], f"{where}.start_s", "a time ≥ 0 in s", "bad_time", positive=False)
    duration_s = require_time(table["duration_s"], f"{where}.duration_s", "a time > 0 in s", "bad_time", positive=True)
    return pixel, start_s, duration_s


def _parse_height_train(
    value: object, where: str, config: Config, pixel_count: int, intensity_model: IntensityModel
) -> HeightTrain:
    known = (*HEIGHT_TRAIN_KEYS, *HEIGHT_TRAIN_TARGETS, "priority")
    table = require_object(value, where, known, HEIGHT_TRAIN_KEYS)
    pixel, start_s, duration_s = _parse_pixel_and_time(table, where, pixel_count)
    period_s = require_time(table["period_s"], f"{where}.period_s", "a period > 0 in s", "bad_train", positive=True)
    priority = require_priority(table.get("priority", 0), f"{where}.priority")
    if select_target_key(table, where) == "intensity":
        if table.get("peak_to_peak_um") is not None:
            expected = "none: an intensity makes the pulses as short as possible"
            raise InputError(f"{where}.peak_to_peak_um", table["peak_to_peak_um"], expected, code="bad_train")
        place = f"{where}.intensity"
        intensity = parse_intensity(table["intensity"], place, is_zero_allowed=False)
        _check_period(HeightTrain(pixel, start_s, duration_s, period_s, 0.0), where, config)
        target_m = intensity_model.solve_train_m(pixel, period_s, duration_s, intensity, place)
        return HeightTrain(pixel, start_s, duration_s, period_s, target_m, priority=priority)
    target_um = require_number(table["target_um"], f"{where}.target_um", "a height > 0 in µm", "bad_target")
    peak_to_peak_um = table.get("peak_to_peak_um")
    peak_to_peak_m = None
    if peak_to_peak_um is not None:
        peak_to_peak_m = um_to_m(
            require_number(peak_to_peak_um, f"{where}.peak_to_peak_um", "a height > 0 in µm", "bad_train")
        )
    train = HeightTrain(pixel, start_s, duration_s, period_s, um_to_m(target_um), peak_to_peak_m, priority)
    return _validate_height_train(train, where, config)


def _validate_height_train(train: HeightTrain, where: str, config: Config) -> HeightTrain:
    if train.target_m <= 0.0:
        raise InputError(f"{where}.target_um", m_to_um(train.target_m), "a height > 0 in µm", code="bad_target")
    _check_height(f"{where}.target_um", train.target_m)
    if train.peak_to_peak_m is not None and not 0.0 < train.peak_to_peak_m <= train.target_m:
        peak_to_peak_um = round(m_to_um(train.peak_to_peak_m), 9)
        expected = f"a height above 0, at most target_um = {m_to_um(train.target_m):g} µm"
        raise InputError(f"{where}.peak_to_peak_um", peak_to_peak_um, expected, code="bad_train")
    if train.peak_to_peak_m is not None and any(laser.is_on_off for laser in config.lasers):
        value, expected = m_to_um(train.peak_to_peak_m), "none with laser.modulation 'on_off': the height alone sets it"
        raise InputError(f"{where}.peak_to_peak_um", round(value, 9), expected, code="bad_train")
    if train.peak_to_peak_m is not None:
        _check_height(f"{where}.peak_to_peak_um", train.peak_to_peak_m)
    _check_period(train, where, config)
    return train


def _check_period(train: HeightTrain, where: str, config: Config) -> None:
    period_min_s = 1.0 / config.laser.pwm_hz + config.limits.pulse_gap_min_s
    if train.period_s < period_min_s * (1 - 1e-9):
        expected = f"at least {period_min_s:g} s, a PWM period and limits.pulse_gap_min_s"
        raise InputError(f"{where}.period_s", train.period_s, expected, code="bad_train")
    _check_repeats(f"{where}.period_s", train.period_s, 0.0, train.duration_s)


def _check_height(where: str, height_m: float) -> None:
    """Raise InputError for a height that is plausible in another unit only."""
    plausible, height_um = PLAUSIBLE[f"trains.{where.rpartition('.')[2]}"], m_to_um(height_m)
    unit = guess_unit(height_um, plausible)
    if not plausible.low * (1.0 - 1e-9) <= height_um <= plausible.high and unit is not None:
        expected = f"{plausible.low:g} to {plausible.high:.0f} µm; this value is likely in {unit}"
        raise InputError(where, Unquoted(f"{height_um:g}"), expected, code="bad_target")


def _check_repeats(where: str, interval_s: float, width_s: float, duration_s: float) -> None:
    """Raise InputError for an interval between pulses that is beyond any train's, or that the train ends before.

    The second is a mistake only if the train would have several pulses with the number read in ms.
    """
    name = where.rpartition(".")[2]
    is_long = interval_s > PLAUSIBLE[f"trains.{name}"].high
    if is_long or (interval_s >= LONG_INTERVAL_S > duration_s > 2.0 * (width_s + 1e-3 * interval_s)):
        expected = "an interval that the train repeats; this value is likely in ms"
        raise InputError(where, interval_s, expected, code="bad_train")


def _guess(name: str, value: float, high: float) -> str:
    """Return a hint at the unit in which a value would be at most `high`."""
    return describe_likely_unit(value, PLAUSIBLE[f"trains.{name}"]._replace(high=high))


def validate_train(train: Train, where: str, config: Config) -> Train:
    """Return the train with its width rounded to whole PWM periods. Raise InputError (bad_train, bad_target)."""
    if isinstance(train, HeightTrain):
        return _validate_height_train(train, where, config)
    return _validate_pulse_train(train, where, config)


def _validate_pulse_train(train: PulseTrain, where: str, config: Config) -> PulseTrain:
    if not 0 < train.power_w <= config.laser.max_power_w:
        expected = f"a power above 0, at most laser.max_power_w = {config.laser.max_power_w:g} W"
        expected += _guess("power_w", train.power_w, config.laser.max_power_w)
        raise InputError(f"{where}.power_w", train.power_w, expected, code="bad_train")
    weakest_w = max(stage.min_power_w for stage in config.list_stage_configs())
    if train.power_w < weakest_w * (1 - 1e-9):
        expected = f"at least {weakest_w:g} W, the weakest pulse of the laser"
        raise InputError(f"{where}.power_w", train.power_w, expected, code="bad_train")
    place, width_max_s = f"{where}.pulse_width_s", config.limits.pulse_width_max_s
    if not 0 < train.pulse_width_s <= width_max_s * (1 + 1e-9):
        expected = f"a width above 0, at most limits.pulse_width_max_s = {width_max_s:g} s"
        expected += _guess("pulse_width_s", train.pulse_width_s, width_max_s)
        raise InputError(place, train.pulse_width_s, expected, code="bad_train")
    _check_repeats(f"{where}.gap_s", train.gap_s, train.pulse_width_s, train.duration_s)
    steps_hz = min(laser.width_steps_hz for laser in config.lasers)
    periods = train.pulse_width_s * steps_hz
    period_count = max(1, round(periods))
    if abs(periods - period_count) > PWM_TOLERANCE_PERIODS:
        nearest_s = float(f"{period_count / steps_hz:.9g}")
        kind = "microseconds" if steps_hz == 1e6 else f"PWM periods of {1 / steps_hz:g} s"
        expected = f"whole {kind}, nearest is {nearest_s!r}"
        raise InputError(place, train.pulse_width_s, expected, code="bad_train")
    return replace(train, pulse_width_s=period_count / steps_hz)


def check_trains(trains: Sequence[Train], where: str, config: Config) -> None:
    """Check the number of pulses, and that no more of them overlap than there are beams, and none on one pixel.

    Abutting pulses are allowed. A height train's pulse, of unknown width, counts as one PWM period; the scheduler
    accounts for settling times. Raises InputError (too_many, overlapping_trains).
    """
    counts = [count_pulses(train) for train in trains]
    by_height = sum(n for train, n in zip(trains, counts, strict=True) if isinstance(train, HeightTrain))
    if by_height > HEIGHT_PULSES_MAX:
        expected = f"at most {HEIGHT_PULSES_MAX} pulses in all height trains"
        raise InputError(where, by_height, expected, code="too_many")
    if sum(counts) > PULSES_MAX:
        raise InputError(where, sum(counts), f"at most {PULSES_MAX} pulses in all trains", code="too_many")
    if not trains:
        return
    start_s = np.concatenate([train.pulse_starts_s() for train in trains])
    owner = np.repeat(np.arange(len(trains)), counts)
    width_s = [1 / config.laser.pwm_hz if isinstance(train, HeightTrain) else train.pulse_width_s for train in trains]
    end_s = start_s + np.array(width_s)[owner]
    beams = len(config.list_stage_configs())
    clash = _find_clash(start_s, end_s, beams)
    if beams > 1 and clash is None:  # no two beams on one pixel
        pixel = np.array([train.pixel for train in trains])[owner]
        found = (_find_clash(start_s[mine], end_s[mine], 1, mine) for mine in _list_by_value(pixel))
        clash, beams = next((one for one in found if one is not None), None), 1
    if clash is not None:
        first, second = clash
        use = f"the beam is in use by {where.rpartition(' ')[2]}[{owner[first]}], from {start_s[first]:.9g} s"
        raise InputError(
            f"{where}[{owner[second]}]",
            round(float(start_s[second]), 9),
            f"a pulse after {end_s[first]:.9g} s: until then {use if beams == 1 else f'all {beams} beams are in use'}",
            code="overlapping_trains",
        )


def _list_by_value(values: IntArray) -> list[IntArray]:
    order = np.argsort(values, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(values[order])) + 1)


def _find_clash(
    start_s: FloatArray, end_s: FloatArray, beams: int, number: IntArray | None = None
) -> tuple[int, int] | None:
    """Return the first of the pulses [n] that finds all beams in use, behind the one that ends first.

    None if no pulse does.

    number: [n] by which the pulses are returned, by default their position
    """
    order = np.argsort(start_s, kind="stable")
    ended = np.searchsorted(np.sort(end_s), start_s[order] + OVERLAP_TOLERANCE_S, side="right")
    clash = np.flatnonzero(np.arange(len(order)) - ended >= beams)
    if not len(clash):
        return None
    second = order[clash[0]]
    before = order[: clash[0]]
    active = before[end_s[before] > start_s[second] + OVERLAP_TOLERANCE_S]
    first = active[np.argmin(end_s[active])]
    return (int(first), int(second)) if number is None else (int(number[first]), int(number[second]))


def count_pulses(train: Train) -> int:
    """Return the number of pulses of a train: those that start before its end."""
    period_s = train.period_s if isinstance(train, HeightTrain) else train.pulse_width_s + train.gap_s
    return max(1, ceil(train.duration_s / period_s - 1e-9))


def train_to_json(train: Train) -> dict[str, object]:
    """Return a train in the form of FRAMES.json. Heights are rounded to 1e-9 µm."""
    if isinstance(train, PulseTrain):
        return {key: getattr(train, key) for key in PULSE_TRAIN_KEYS}
    entry: dict[str, object] = {key: getattr(train, key) for key in HEIGHT_TRAIN_KEYS}
    entry["target_um"] = round(m_to_um(train.target_m), 9)
    if train.peak_to_peak_m is not None:
        entry["peak_to_peak_um"] = round(m_to_um(train.peak_to_peak_m), 9)
    return entry
