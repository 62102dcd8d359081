"""Spots and mirrors through the sensor, while the board is held."""

from math import sqrt
from statistics import fmean, median

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError, RefusedError
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.lab.commissioning.spot_sensor_client import SpotReading, SpotSensorClient

ANSWER_TIMEOUT_S = 1.0
ATTEMPTS = 3
"""So often a place is lit before it counts as unseen."""
OUTLIER_SIGMAS = 6.0
"""Readings so many sigma from their middle are something else: a reflection."""
OUTLIER_MIN_M = 1e-6


class SpotReader:
    """A held board's sensor: keeps the lease while it waits for answers."""

    def __init__(self, board: ExclusiveBoard, sensor: SpotSensorClient, clock: Clock) -> None:
        self._board, self._sensor, self._clock = board, sensor, clock

    @property
    def port(self) -> str:
        """Where the sensor is."""
        return self._sensor.port

    def read_spot(self, x_code: int, y_code: int, power_w: float, readings: int) -> SpotReading | None:
        """Light a place and see where the beam lands: the mean of several readings, less those far from their middle.

        None where nothing is seen however often it is lit.
        """
        collected: list[SpotReading] = []
        for _ in range(readings):
            reading = self._read_once(x_code, y_code, power_w)
            if reading is None:
                return None
            collected.append(reading)
        return robust_mean(collected)

    def _read_once(self, x_code: int, y_code: int, power_w: float) -> SpotReading | None:
        for _ in range(ATTEMPTS):
            if self._query_spot() is not None:
                raise RefusedError(
                    f"sensor at {self.port}: sees a spot though the beam is dark: shield it from other light"
                )
            self._board.fire_spot(x_code, y_code, power_w)
            reading = self._query_spot()
            if reading is not None:
                return reading
        return None

    def read_mirrors_rad(self) -> tuple[float, float] | None:
        """Where the position outputs say that the mirrors stand; None where there are none."""
        return self._sensor.parse_mirrors_rad(self._query("mirrors"))

    def open(self) -> None:
        """Open the sensor's port; InputError where there is none, LinkError where no sensor answers."""
        self._sensor.open()
        self._query_spot()

    def close(self) -> None:
        """Close the sensor's port."""
        self._sensor.close()

    def _query_spot(self) -> SpotReading | None:
        return self._sensor.parse_spot(self._query("spot"))

    def _query(self, request: str) -> str:
        self._sensor.send_request(request)
        until_s = self._clock.now_s() + ANSWER_TIMEOUT_S
        while (line := self._sensor.poll_answer()) is None:
            if self._clock.now_s() > until_s:
                raise LinkError(
                    f"sensor at {self.port}: no answer within {ANSWER_TIMEOUT_S:g} s: is it powered, the right port and rate?"
                )
            self._board.step()
        return line


def robust_mean(readings: list[SpotReading]) -> SpotReading:
    """The mean of readings that lie near their medians; of the first where none do."""
    x_m, y_m = median(each.x_m for each in readings), median(each.y_m for each in readings)
    inliers = [
        each
        for each in readings
        if max(abs(each.x_m - x_m), abs(each.y_m - y_m)) <= max(OUTLIER_SIGMAS * each.sigma_m, OUTLIER_MIN_M)
    ] or readings[:1]
    return SpotReading(
        fmean(each.x_m for each in inliers),
        fmean(each.y_m for each in inliers),
        inliers[0].sigma_m / sqrt(len(inliers)),
    )
