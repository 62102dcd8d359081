"""Pulse trains: from JSON, and what must hold for them on one beam, whoever made them."""

from collections.abc import Sequence
from dataclasses import replace
from math import ceil

import numpy as np

from optodrive.config import Config
from optodrive.errors import InputError
from optodrive.flow import PulseTrain
from optodrive.frames.fields import number_at, priority_at, table_at, time_at

TRAIN_KEYS = ("pixel", "start_s", "duration_s", "pulse_width_s", "gap_s", "power_w")
PULSES_MAX = 2_000_000
OVERLAP_S = 1e-9
"""Pulses may share this much, the rounding of their times."""

PWM_TOLERANCE = 0.01
"""How far from a whole number of PWM periods a width may be written, in periods; it is played as the whole number."""


def parse_train(value: object, where: str, config: Config, pixel_count: int) -> PulseTrain:
    """One entry of `trains`; raises InputError (bad_train, bad_time, bad_priority, unknown_pixel, …)."""
    table = table_at(value, where, (*TRAIN_KEYS, "priority"), TRAIN_KEYS)
    pixel = table["pixel"]
    if type(pixel) is not int or not 0 <= pixel < pixel_count:
        raise InputError(f"{where}.pixel", pixel, f"a pixel, 0…{pixel_count - 1}", code="unknown_pixel")
    start_s = time_at(table["start_s"], f"{where}.start_s", "a time ≥ 0 in s", "bad_time", positive=False)
    duration_s = time_at(table["duration_s"], f"{where}.duration_s", "a time > 0 in s", "bad_time", positive=True)
    gap_s = time_at(table["gap_s"], f"{where}.gap_s", "a gap ≥ 0 in s", "bad_train", positive=False)
    width_s = number_at(table["pulse_width_s"], f"{where}.pulse_width_s", "a width > 0 in s", "bad_train")
    power_w = number_at(table["power_w"], f"{where}.power_w", "a power > 0 in W", "bad_train")
    priority = priority_at(table.get("priority", 0), f"{where}.priority")
    return checked_train(PulseTrain(pixel, start_s, duration_s, width_s, gap_s, power_w, priority), where, config)


def checked_train(train: PulseTrain, where: str, config: Config) -> PulseTrain:
    """The train with its width at the whole number of PWM periods; raises InputError (bad_train) for width or power."""
    if not 0 < train.power_w <= config.laser.max_power_w:
        expected = f"a power above 0, at most laser.max_power_w = {config.laser.max_power_w:g} W"
        raise InputError(f"{where}.power_w", train.power_w, expected, code="bad_train")
    place, longest_s = f"{where}.pulse_width_s", config.limits.pulse_width_max_s
    if not 0 < train.pulse_width_s <= longest_s * (1 + 1e-9):
        expected = f"a width above 0, at most limits.pulse_width_max_s = {longest_s:g} s"
        raise InputError(place, train.pulse_width_s, expected, code="bad_train")
    periods = train.pulse_width_s * config.laser.pwm_hz
    whole = max(1, round(periods))
    if abs(periods - whole) > PWM_TOLERANCE:
        nearest_s = float(f"{whole / config.laser.pwm_hz:.9g}")
        expected = f"whole PWM periods of {1 / config.laser.pwm_hz:g} s, nearest is {nearest_s!r}"
        raise InputError(place, train.pulse_width_s, expected, code="bad_train")
    return replace(train, pulse_width_s=whole / config.laser.pwm_hz)


def check_trains(trains: Sequence[PulseTrain], where: str) -> None:
    """Refuse more pulses than are planned at once, and pulses of two trains at the same time: there is one beam.

    Raises InputError (too_many, overlapping_trains); pulses that abut are fine.
    """
    counts = [pulse_count(train) for train in trains]
    if sum(counts) > PULSES_MAX:
        raise InputError(where, sum(counts), f"at most {PULSES_MAX} pulses in all trains", code="too_many")
    if not trains:
        return
    start_s = np.concatenate([train.pulse_starts_s() for train in trains])
    owner = np.repeat(np.arange(len(trains)), counts)
    end_s = start_s + np.array([train.pulse_width_s for train in trains])[owner]
    order = np.argsort(start_s, kind="stable")
    # Sorted by start, two pulses overlap somewhere only if two neighbours do.
    clash = np.flatnonzero(start_s[order][1:] < end_s[order][:-1] - OVERLAP_S)
    if len(clash):
        first, second = (int(pulse) for pulse in order[clash[0] : clash[0] + 2])
        raise InputError(
            f"{where}[{owner[second]}]",
            round(float(start_s[second]), 9),
            f"a pulse after {end_s[first]:.9g} s: until then the one beam is on for {where.rpartition(' ')[2]}"
            f"[{owner[first]}], from {start_s[first]:.9g} s",
            code="overlapping_trains",
        )


def pulse_count(train: PulseTrain) -> int:
    """Pulses of a train, without making them: those that start before its end."""
    return max(1, ceil(train.duration_s / (train.pulse_width_s + train.gap_s) - 1e-9))
