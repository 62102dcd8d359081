"""Pulses of all trains in order of time, and how much of the beam each pulse of a height train may have."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from optodrive.flow import HeightTrain, Train


class TrainPulse(NamedTuple):
    """One pulse as a train asks for it; width and power are zero where they follow from a height."""

    nominal_us: int
    source: int
    pixel: int
    width_us: int
    power_w: float


def train_pulses(trains: tuple[Train, ...], first_source: int) -> list[TrainPulse]:
    """Every pulse of the trains, in order of time; sources count on from first_source."""
    pulses = []
    for source, train in enumerate(trains, start=first_source):
        width_s, power_w = (0.0, 0.0) if isinstance(train, HeightTrain) else (train.pulse_width_s, train.power_w)
        width_us = round(width_s * 1e6)
        pulses += [
            TrainPulse(round(start_s * 1e6), source, train.pixel, width_us, power_w)
            for start_s in train.pulse_starts_s()
        ]
    return sorted(pulses)


def free_us(pulses: list[TrainPulse], index: int, rest_us: int, move_us: Callable[[int, int], int]) -> int:
    """Beam time from the nominal start of a pulse to when the beam must leave for the next one of any train, µs.

    A pixel lit again at once is given rest_us in the dark. Very long after the last pulse.
    """
    if index + 1 >= len(pulses):
        return 2**40
    pulse, following = pulses[index], pulses[index + 1]
    between_us = rest_us if following.pixel == pulse.pixel else move_us(pulse.pixel, following.pixel)
    return following.nominal_us - pulse.nominal_us - between_us


def usual_free_us(
    pulses: list[TrainPulse], sources: set[int], rest_us: int, move_us: Callable[[int, int], int]
) -> dict[int, tuple[int, int]]:
    """The least, and the usual (median), beam time that the pulses of some trains have, µs, by source."""
    free: dict[int, list[int]] = {source: [] for source in sources}
    for k, pulse in enumerate(pulses):
        if pulse.source in free:
            free[pulse.source].append(free_us(pulses, k, rest_us, move_us))
    return {source: (min(each), int(np.median(each))) for source, each in free.items()}
