"""Readings of spots and mirrors from the sensor, with exclusive access to the board."""

from math import sqrt
from statistics import fmean, median

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError, RefusedError
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.lab.commissioning.spot_sensor_client import SpotReading, SpotSensorClient

ANSWER_TIMEOUT_S = 1.0
ATTEMPTS = 3
"""Pulses at a position before it counts as without a spot."""
OUTLIER_SIGMAS = 6.0
"""Readings farther than this from the median are outliers, for example reflections."""
OUTLIER_MIN_M = 1e-6


class SpotReader:
    """Reads the sensor and keeps the board's lease while it waits."""

    def __init__(self, board: ExclusiveBoard, sensor: SpotSensorClient, clock: Clock) -> None:
        self._board, self.sensor, self._clock = board, sensor, clock

    @property
    def port(self) -> str:
        """The sensor's port."""
        return self.sensor.port

    def read_spot(self, x_code: int, y_code: int, power_w: float, readings: int) -> SpotReading | None:
        """Measure a spot as the mean of several readings without outliers. Return None if no spot is detected.

        Raise RefusedError if the sensor detects a spot with the gate off.
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
                    f"sensor at {self.port}: sees a spot with the beam off: shield it from ambient light"
                )
            self._board.fire_spot(x_code, y_code, power_w)
            reading = self._query_spot()
            if reading is not None:
                return reading
        return None

    def read_mirrors_rad(self) -> tuple[float, float] | None:
        """Return the position outputs of the mirrors, rad. Return None without position outputs."""
        return self.sensor.parse_mirrors_rad(self.query("mirrors"))

    def open(self) -> None:
        """Open the sensor's port. Raise InputError if it does not exist, LinkError if no sensor answers."""
        self.sensor.open()
        self._query_spot()

    def close(self) -> None:
        """Close the sensor's port."""
        self.sensor.close()

    def query(self, request: str) -> str:
        """Send a request line and return the answer. Raise LinkError without one."""
        self.sensor.send_request(request)
        until_s = self._clock.now_s() + ANSWER_TIMEOUT_S
        while (line := self.sensor.poll_answer()) is None:
            if self._clock.now_s() > until_s:
                raise LinkError(
                    f"sensor at {self.port}: no answer within {ANSWER_TIMEOUT_S:g} s: "
                    "is it powered, and are port and baud rate right?"
                )
            self._board.step()
        return line

    def _query_spot(self) -> SpotReading | None:
        return self.sensor.parse_spot(self.query("spot"))


def robust_mean(readings: list[SpotReading]) -> SpotReading:
    """Return the mean of the readings near their median. Return the first reading if none is near."""
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
