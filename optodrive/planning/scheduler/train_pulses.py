"""Pulses of all trains in order of time, and what each of them is made of."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import HeightTrain, Train
from optodrive.physics.nominal_display import ignore_progress
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.scheduler.periodic_pulses import (
    PulseRecipe,
    build_pulse_recipe,
    compute_next_pulse,
    limit_pulse_width,
)

SettlingTime = Callable[[int, int], int]
"""Dark time of a move from one pixel to another, µs."""


class TrainPulse(NamedTuple):
    """One pulse as a train asks for it; width and power are zero where they follow from a height."""

    requested_start_us: int
    source: int
    pixel: int
    width_us: int
    power_w: float

    @property
    def is_by_height(self) -> bool:
        """Whether its width and power follow from the heat there."""
        return not self.width_us


def list_train_pulses(trains: tuple[Train, ...], first_source: int) -> list[TrainPulse]:
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


def compute_free_us(pulses: list[TrainPulse], index: int, gap_us: int, settling_us: SettlingTime) -> int:
    """Beam time from the nominal start of a pulse to when the beam must leave for the next one of any train, µs.

    A pixel lit again at once is given gap_us in the dark. Very long after the last pulse.
    """
    if index + 1 >= len(pulses):
        return 2**40
    pulse, following = pulses[index], pulses[index + 1]
    between_us = gap_us if following.pixel == pulse.pixel else settling_us(pulse.pixel, following.pixel)
    return following.requested_start_us - pulse.requested_start_us - between_us


def compute_free_us_by_source(
    pulses: list[TrainPulse], sources: set[int], gap_us: int, settling_us: SettlingTime
) -> dict[int, tuple[int, int]]:
    """The least, and the usual (median), beam time that the pulses of some trains have, µs, by source."""
    free: dict[int, list[int]] = {source: [] for source in sources}
    for k, pulse in enumerate(pulses):
        if pulse.source in free:
            free[pulse.source].append(compute_free_us(pulses, k, gap_us, settling_us))
    return {source: (min(each), int(np.median(each))) for source, each in free.items()}


def add_lead_periods(
    pulses: list[TrainPulse],
    lead_periods_w: dict[int, float],
    lead_period_us: int,
    gap_us: int,
    settling_us: SettlingTime,
) -> list[TrainPulse]:
    """The pulses, those of some sources begun by a head of so much power where there is room for both."""
    result = []
    for k, pulse in enumerate(pulses):
        if pulse.source in lead_periods_w and compute_free_us(pulses, k, gap_us, settling_us) >= 2 * lead_period_us:
            result.append(pulse._replace(width_us=lead_period_us, power_w=lead_periods_w[pulse.source]))
            pulse = pulse._replace(requested_start_us=pulse.requested_start_us + lead_period_us)
        result.append(pulse)
    return result


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
        gap_us: int,
        settling_us: SettlingTime,
        build_cold_heat: Callable[[], ThermalState],
        on_progress: Callable[[], None] = ignore_progress,
    ) -> None:
        self._drive = drive
        self._gap_us = gap_us
        self._settling_us = settling_us
        self._period_us = round(drive.period_s * 1e6)
        self._trains = {k: t for k, t in enumerate(trains, first_source) if isinstance(t, HeightTrain)}
        self._pulses = list_train_pulses(trains, first_source)
        self._recipes: dict[int, PulseRecipe] = {}
        if self._trains:
            self._build_recipes(first_source, build_cold_heat(), on_progress)
            lead_periods_w = {
                source: cycle.lead_period_w for source, cycle in self._recipes.items() if cycle.lead_period_w
            }
            self._pulses = add_lead_periods(self._pulses, lead_periods_w, self._period_us, gap_us, settling_us)

    def __len__(self) -> int:
        return len(self._pulses)

    def __getitem__(self, index: int) -> TrainPulse:
        return self._pulses[index]

    def get_target_m(self, source: int) -> float:
        """The height that a train by height asks for."""
        return self._trains[source].target_m

    def plan_pulse(self, index: int, heat: ThermalState, start_us: int, late_us: int) -> tuple[int, float] | None:
        """Width, µs, and power, W, of a pulse by height that starts at start_us, so much late; None: none is needed."""
        pulse = self._pulses[index]
        train, recipe = self._trains[pulse.source], self._recipes[pulse.source]
        max_width_us = self._compute_max_width_us(train) - (self._period_us if recipe.lead_period_w else 0)
        room_us = min(compute_free_us(self._pulses, index, self._gap_us, self._settling_us) - late_us, max_width_us)
        shape = compute_next_pulse(train, recipe, heat, start_us * 1e-6, limit_pulse_width(self._drive, room_us))
        if shape is None:
            return None
        return round(shape[0] * self._drive.period_s * 1e6), shape[1] * self._drive.max_power_w

    def _compute_max_width_us(self, train: HeightTrain) -> int:
        return round(train.period_s * 1e6) - self._gap_us

    def _build_recipes(self, first_source: int, cold_heat: ThermalState, on_progress: Callable[[], None]) -> None:
        free = compute_free_us_by_source(self._pulses, set(self._trains), self._gap_us, self._settling_us)
        for source, train in self._trains.items():
            on_progress()
            self._recipes[source] = self._build_recipe(
                train, cold_heat, *free[source], f"trains[{source - first_source}]"
            )

    def _build_recipe(
        self, train: HeightTrain, cold_heat: ThermalState, min_free_us: int, median_free_us: int, where: str
    ) -> PulseRecipe:
        room_us = min(median_free_us, self._compute_max_width_us(train))
        if min(min_free_us, room_us) < self._drive.period_s * 1e6:
            expected = (
                f"room for a PWM period of {self._drive.period_s * 1e3:g} ms from a pulse's start to the next pulse of "
                f"any train, with the mirrors' move or a rest of {self._gap_us * 1e-3:g} ms"
            )
            raise InputError(f"{where}.period_s", train.period_s, expected, code="overlapping_trains")
        return build_pulse_recipe(train, cold_heat, limit_pulse_width(self._drive, room_us), where)
