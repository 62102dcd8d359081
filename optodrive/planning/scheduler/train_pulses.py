"""Pulses of all trains in order of time, and what each of them is made of."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import HeightTrain, Train
from optodrive.physics.nominal_display import nothing
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import Heat
from optodrive.planning.scheduler.periodic_pulses import Cycle, cycle_of, next_pulse, with_room

MoveUs = Callable[[int, int], int]
"""Dark time of a move from one pixel to another, µs."""


class TrainPulse(NamedTuple):
    """One pulse as a train asks for it; width and power are zero where they follow from a height."""

    nominal_us: int
    source: int
    pixel: int
    width_us: int
    power_w: float

    @property
    def by_height(self) -> bool:
        """Whether its width and power follow from the heat there."""
        return not self.width_us


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


def free_us(pulses: list[TrainPulse], index: int, rest_us: int, move_us: MoveUs) -> int:
    """Beam time from the nominal start of a pulse to when the beam must leave for the next one of any train, µs.

    A pixel lit again at once is given rest_us in the dark. Very long after the last pulse.
    """
    if index + 1 >= len(pulses):
        return 2**40
    pulse, following = pulses[index], pulses[index + 1]
    between_us = rest_us if following.pixel == pulse.pixel else move_us(pulse.pixel, following.pixel)
    return following.nominal_us - pulse.nominal_us - between_us


def usual_free_us(
    pulses: list[TrainPulse], sources: set[int], rest_us: int, move_us: MoveUs
) -> dict[int, tuple[int, int]]:
    """The least, and the usual (median), beam time that the pulses of some trains have, µs, by source."""
    free: dict[int, list[int]] = {source: [] for source in sources}
    for k, pulse in enumerate(pulses):
        if pulse.source in free:
            free[pulse.source].append(free_us(pulses, k, rest_us, move_us))
    return {source: (min(each), int(np.median(each))) for source, each in free.items()}


def with_heads(
    pulses: list[TrainPulse],
    heads_w: dict[int, float],
    head_us: int,
    rest_us: int,
    move_us: MoveUs,
) -> list[TrainPulse]:
    """The pulses, those of some sources begun by a head of so much power where there is room for both."""
    headed = []
    for k, pulse in enumerate(pulses):
        if pulse.source in heads_w and free_us(pulses, k, rest_us, move_us) >= 2 * head_us:
            headed.append(pulse._replace(width_us=head_us, power_w=heads_w[pulse.source]))
            pulse = pulse._replace(nominal_us=pulse.nominal_us + head_us)
        headed.append(pulse)
    return headed


class TrainPulses:
    """Every pulse of the trains in order of time, and how those by height are planned.

    at_rest: makes the display's heat before anybody lit it; tick: called again and again.
    Raises InputError for a train whose height or swing its cycles cannot have, or that leaves the beam no time.
    """

    def __init__(
        self,
        trains: tuple[Train, ...],
        first_source: int,
        drive: DriveRange,
        rest_us: int,
        move_us: MoveUs,
        at_rest: Callable[[], Heat],
        tick: Callable[[], None] = nothing,
    ) -> None:
        self._drive = drive
        self._rest_us = rest_us
        self._move_us = move_us
        self._period_us = round(drive.period_s * 1e6)
        self._trains = {k: t for k, t in enumerate(trains, first_source) if isinstance(t, HeightTrain)}
        self._pulses = train_pulses(trains, first_source)
        self._cycles: dict[int, Cycle] = {}
        if self._trains:
            self._plan_cycles(first_source, at_rest(), tick)
            heads_w = {source: cycle.head_w for source, cycle in self._cycles.items() if cycle.head_w}
            self._pulses = with_heads(self._pulses, heads_w, self._period_us, rest_us, move_us)

    def __len__(self) -> int:
        return len(self._pulses)

    def __getitem__(self, index: int) -> TrainPulse:
        return self._pulses[index]

    def target_m(self, source: int) -> float:
        """The height that a train by height asks for."""
        return self._trains[source].target_m

    def planned(self, index: int, heat: Heat, start_us: int, late_us: int) -> tuple[int, float] | None:
        """Width, µs, and power, W, of a pulse by height that starts at start_us, so much late; None: none is needed."""
        pulse = self._pulses[index]
        train, cycle = self._trains[pulse.source], self._cycles[pulse.source]
        own_us = self._own_room_us(train) - (self._period_us if cycle.head_w else 0)
        room_us = min(free_us(self._pulses, index, self._rest_us, self._move_us) - late_us, own_us)
        found = next_pulse(train, cycle, heat, start_us * 1e-6, with_room(self._drive, room_us))
        if found is None:
            return None
        return round(found[0] * self._drive.period_s * 1e6), found[1] * self._drive.max_power_w

    def _own_room_us(self, train: HeightTrain) -> int:
        return round(train.period_s * 1e6) - self._rest_us

    def _plan_cycles(self, first_source: int, rest: Heat, tick: Callable[[], None]) -> None:
        free = usual_free_us(self._pulses, set(self._trains), self._rest_us, self._move_us)
        for source, train in self._trains.items():
            tick()
            self._cycles[source] = self._cycle(train, rest, *free[source], f"trains[{source - first_source}]")

    def _cycle(self, train: HeightTrain, rest: Heat, least_us: int, usual_us: int, where: str) -> Cycle:
        room_us = min(usual_us, self._own_room_us(train))
        if min(least_us, room_us) < self._drive.period_s * 1e6:
            expected = (
                f"room for a PWM period of {self._drive.period_s * 1e3:g} ms from a pulse's start to the next pulse of "
                f"any train, with the mirrors' move or a rest of {self._rest_us * 1e-3:g} ms"
            )
            raise InputError(f"{where}.period_s", train.period_s, expected, code="overlapping_trains")
        return cycle_of(train, rest, with_room(self._drive, room_us), where)
