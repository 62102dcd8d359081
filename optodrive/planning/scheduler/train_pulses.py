"""The pulses of all trains in order of time, and the shape of each pulse."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity
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
"""Returns the settling time of a move from one pixel to another, µs."""
PROGRESS_PULSES = 20_000
"""Pulses between two progress reports: tens of milliseconds."""


class TrainPulse(NamedTuple):
    """One requested pulse of a train. Width and power are zero if they follow from a height."""

    requested_start_us: int
    source: int
    pixel: int
    width_us: int
    power_w: float

    @property
    def is_by_height(self) -> bool:
        """Whether width and power follow from a height and the residual heat."""
        return not self.width_us


def list_train_pulses(
    trains: Mapping[int, Train], on_progress: Callable[[], None] = ignore_progress
) -> list[TrainPulse]:
    """List the pulses of all trains, by source, in order of time, at equal times in that of the trains.

    on_progress: called repeatedly
    """
    starts_us, shapes, sources = [], [], list(trains)
    for train in trains.values():
        starts_us.append(np.rint(train.pulse_starts_s() * 1e6).astype(np.int64))
        width_s, power_w = (0.0, 0.0) if isinstance(train, HeightTrain) else (train.pulse_width_s, train.power_w)
        shapes.append((train.pixel, round(width_s * 1e6), power_w))
        on_progress()
    if not trains:
        return []
    start_us, number = np.concatenate(starts_us), np.repeat(np.arange(len(trains)), [len(each) for each in starts_us])
    # Stable: at equal times in the order of the trains.
    order = np.argsort(start_us, kind="stable")
    pulses: list[TrainPulse] = []
    for first in range(0, len(order), PROGRESS_PULSES):
        chunk = order[first : first + PROGRESS_PULSES]
        for at_us, train_number in zip(start_us[chunk].tolist(), number[chunk].tolist(), strict=True):
            pulses.append(TrainPulse(at_us, sources[train_number], *shapes[train_number]))
        on_progress()
    return pulses


def compute_free_us(pulses: list[TrainPulse], index: int, gap_us: int, settling_us: SettlingTime) -> int:
    """Return the beam time from a pulse's requested start until the beam must leave for the next train pulse, µs.

    gap_us: gate-off time before the next pulse on the same pixel. Practically unlimited for the last pulse.
    """
    if index + 1 >= len(pulses):
        # Twelve days: no next pulse limits the last one.
        return 2**40
    pulse, following = pulses[index], pulses[index + 1]
    # On the same pixel no move, but a gap, or both pulses would count as one in the width cap.
    between_us = gap_us if following.pixel == pulse.pixel else settling_us(pulse.pixel, following.pixel)
    return following.requested_start_us - pulse.requested_start_us - between_us


def compute_free_us_by_source(
    pulses: list[TrainPulse], sources: set[int], gap_us: int, settling_us: SettlingTime, on_progress: Callable[[], None]
) -> dict[int, tuple[int, int]]:
    """Return the minimum and the median beam time of the pulses of the given trains, µs, by source."""
    free: dict[int, list[int]] = {source: [] for source in sources}
    for k, pulse in enumerate(pulses):
        if k % PROGRESS_PULSES == 0:
            on_progress()
        if pulse.source in free:
            free[pulse.source].append(compute_free_us(pulses, k, gap_us, settling_us))
    return {source: (min(each), int(np.median(each))) for source, each in free.items()}


def add_lead_periods(
    pulses: list[TrainPulse],
    lead_periods_w: dict[int, float],
    lead_period_us: int,
    gap_us: int,
    settling_us: SettlingTime,
    on_progress: Callable[[], None],
) -> list[TrainPulse]:
    """Put a lead period before each pulse of the given sources, where the beam time suffices for both.

    lead_periods_w: power of the lead period, by source; lead_period_us: its width.
    """
    result = []
    for k, pulse in enumerate(pulses):
        if k % PROGRESS_PULSES == 0:
            on_progress()
        if pulse.source in lead_periods_w and compute_free_us(pulses, k, gap_us, settling_us) >= 2 * lead_period_us:
            result.append(pulse._replace(width_us=lead_period_us, power_w=lead_periods_w[pulse.source]))
            pulse = pulse._replace(requested_start_us=pulse.requested_start_us + lead_period_us)
        result.append(pulse)
    return result


class TrainPulses:
    """The pulses of a stage's trains, by source, in order of time, with the pulse recipes of trains by height.

    first_source: source index of the sequence's first train
    gap_us: gate-off time after which pulses on a pixel count separately
    build_cold_heat: makes the heat of a cold display; on_progress: called repeatedly
    Raises InputError for a train by height whose height or peak-to-peak value no cycle has, or that has no beam time.
    """

    def __init__(
        self,
        trains: Mapping[int, Train],
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
        self._trains = {source: train for source, train in trains.items() if isinstance(train, HeightTrain)}
        self._pulses = list_train_pulses(trains, on_progress)
        self._recipes: dict[int, PulseRecipe] = {}
        if self._trains:
            self._build_recipes(first_source, build_cold_heat(), on_progress)
            lead_periods_w = {
                source: cycle.lead_period_w for source, cycle in self._recipes.items() if cycle.lead_period_w
            }
            self._pulses = add_lead_periods(
                self._pulses, lead_periods_w, self._period_us, gap_us, settling_us, on_progress
            )

    def __len__(self) -> int:
        return len(self._pulses)

    def __getitem__(self, index: int) -> TrainPulse:
        return self._pulses[index]

    def get_target_m(self, source: int) -> float:
        """Return the target height of a train by height, m."""
        return self._trains[source].target_m

    def plan_pulse(self, index: int, heat: ThermalState, start_us: int, late_us: int) -> tuple[int, float] | None:
        """Compute width, µs, and power, W, of a pulse by height from the residual heat. Return None if none is needed.

        late_us: delay of `start_us` after the requested start.
        """
        pulse = self._pulses[index]
        train, recipe = self._trains[pulse.source], self._recipes[pulse.source]
        # The lead period takes its time from the same cycle.
        max_width_us = self._compute_max_width_us(train) - (self._period_us if recipe.lead_period_w else 0)
        room_us = min(compute_free_us(self._pulses, index, self._gap_us, self._settling_us) - late_us, max_width_us)
        shape = compute_next_pulse(train, recipe, heat, start_us * 1e-6, limit_pulse_width(self._drive, room_us))
        if shape is None:
            return None
        return round(shape[0] * self._drive.period_s * 1e6), shape[1] * self._drive.max_power_w

    def _compute_max_width_us(self, train: HeightTrain) -> int:
        return round(train.period_s * 1e6) - self._gap_us

    def _build_recipes(self, first_source: int, cold_heat: ThermalState, on_progress: Callable[[], None]) -> None:
        free = compute_free_us_by_source(self._pulses, set(self._trains), self._gap_us, self._settling_us, on_progress)
        for source, train in self._trains.items():
            on_progress()
            self._recipes[source] = self._build_recipe(
                train, cold_heat, *free[source], f"trains[{source - first_source}]"
            )

    def _build_recipe(
        self, train: HeightTrain, cold_heat: ThermalState, min_free_us: int, median_free_us: int, where: str
    ) -> PulseRecipe:
        # The median: a few tight cycles are planned narrower one by one, and must not make all of them narrow.
        room_us = min(median_free_us, self._compute_max_width_us(train))
        if min(min_free_us, room_us) < self._drive.period_s * 1e6:
            expected = (
                f"time for a PWM period of {format_quantity(self._drive.period_s, 's')} from a pulse's start to the "
                f"next pulse of any train, with a move of the mirrors or "
                f"a gap of {format_quantity(self._gap_us * 1e-6, 's')}"
            )
            raise InputError(f"{where}.period_s", train.period_s, expected, code="overlapping_trains")
        return build_pulse_recipe(train, cold_heat, limit_pulse_width(self._drive, room_us), where)
