"""Spots and mirrors through the sensor, while the board is held."""

from math import sqrt
from statistics import fmean, median

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError, RefusedError
from optodrive.lab.commissioning.exclusive_board import HeldBoard
from optodrive.lab.commissioning.spot_sensor_client import Sighting, SpotSensor

ANSWER_S = 1.0
TRIES = 3
"""So often a place is lit before it counts as unseen."""
ALIKE = 6.0
"""Readings so many sigma from their middle are something else: a reflection."""
LEAST_ALIKE_M = 1e-6


class Eyes:
    """A held board's sensor: keeps the lease while it waits for answers."""

    def __init__(self, held: HeldBoard, sensor: SpotSensor, clock: Clock) -> None:
        self._held, self._sensor, self._clock = held, sensor, clock

    @property
    def port(self) -> str:
        """Where the sensor is."""
        return self._sensor.port

    def spot(self, x_code: int, y_code: int, power_w: float, readings: int) -> Sighting | None:
        """Light a place and see where the beam lands: the mean of several readings, less those far from their middle.

        None where nothing is seen however often it is lit.
        """
        seen: list[Sighting] = []
        for _ in range(readings):
            sighting = self._one(x_code, y_code, power_w)
            if sighting is None:
                return None
            seen.append(sighting)
        return agreed(seen)

    def _one(self, x_code: int, y_code: int, power_w: float) -> Sighting | None:
        for _ in range(TRIES):
            if self._seen() is not None:
                raise RefusedError(
                    f"sensor at {self.port}: sees a spot though the beam is dark: shield it from other light"
                )
            self._held.light(x_code, y_code, power_w)
            seen = self._seen()
            if seen is not None:
                return seen
        return None

    def mirrors_rad(self) -> tuple[float, float] | None:
        """Where the position outputs say that the mirrors stand; None where there are none."""
        return self._sensor.mirrors_rad(self._answer("mirrors"))

    def open(self) -> None:
        """Open the sensor's port; InputError where there is none, LinkError where no sensor answers."""
        self._sensor.open()
        self._seen()

    def close(self) -> None:
        """Close the sensor's port."""
        self._sensor.close()

    def _seen(self) -> Sighting | None:
        return self._sensor.sighting(self._answer("spot"))

    def _answer(self, request: str) -> str:
        self._sensor.ask(request)
        until_s = self._clock.now_s() + ANSWER_S
        while (line := self._sensor.answer()) is None:
            if self._clock.now_s() > until_s:
                raise LinkError(
                    f"sensor at {self.port}: no answer within {ANSWER_S:g} s: is it powered, the right port and rate?"
                )
            self._held.step()
        return line


def agreed(readings: list[Sighting]) -> Sighting:
    """The mean of readings that lie near their medians; of the first where none do."""
    x_m, y_m = median(each.x_m for each in readings), median(each.y_m for each in readings)
    near = [
        each
        for each in readings
        if max(abs(each.x_m - x_m), abs(each.y_m - y_m)) <= max(ALIKE * each.sigma_m, LEAST_ALIKE_M)
    ] or readings[:1]
    return Sighting(
        fmean(each.x_m for each in near),
        fmean(each.y_m for each in near),
        near[0].sigma_m / sqrt(len(near)),
    )
