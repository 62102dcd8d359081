"""The sensor of a bench: its protocol of lines, and readings of spots, mirrors and pixels beside an armed board.

The client is non-blocking: one request line, one answer line, see SENSOR.md. The readers keep the board's lease while
they wait for an answer.
"""

from math import isfinite, sqrt
from statistics import fmean, median
from typing import NamedTuple

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, RefusedError
from optodrive.core.quantity import um_to_m
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.lab.recording.storage import MIRROR_SIGNALS, SIGNALS
from optodrive.link.transport.base import Transport

PIXEL_SIGNALS = tuple(name for name in SIGNALS if name not in MIRROR_SIGNALS)
LINE_MAX = 1024
SHOWN_MAX = 64
"""Characters of an invalid answer that a message shows."""
ANSWER_TIMEOUT_S = 1.0
ATTEMPTS = 3
"""Pulses at a position before it counts as without a spot."""
OUTLIER_SIGMAS = 6.0
"""Readings farther than this from the median are outliers, for example reflections."""
OUTLIER_MIN_M = 1e-6
LATE_MAX_S = 2.0
"""Time after the last sample in which the recording must be complete."""
POLL_S = 0.05


class SpotReading(NamedTuple):
    """Position of a spot on the display, and its standard deviation per axis, m."""

    x_m: float
    y_m: float
    sigma_m: float


class SpotSensorClient:
    """A sensor on its own transport. Methods raise LinkError if the link fails or an answer is invalid."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._buffer = b""

    @property
    def port(self) -> str:
        """The transport's name."""
        return self._transport.name

    def open(self) -> None:
        """Open the port. Raise InputError if it does not exist."""
        self._transport.open()

    def close(self) -> None:
        """Close the port."""
        self._transport.release()

    def send_request(self, request: str) -> None:
        """Send a request line. Discard input that arrived before it."""
        self._read()
        self._buffer = b""
        try:
            self._transport.write(request.encode("ascii") + b"\n")
        except LinkError as error:
            raise self._build_lost_error(error) from None

    def poll_answer(self) -> str | None:
        """Return the answer line, None if it has not arrived yet."""
        self._buffer += self._read()
        line, end, _ = self._buffer.partition(b"\n")
        if not end:
            # A port with another device may send without end.
            if len(self._buffer) > LINE_MAX:
                raise self._build_answer_error(self._buffer.decode("ascii", "replace"), "a line")
            return None
        return line.decode("ascii", "replace").strip()

    def _read(self) -> bytes:
        try:
            return self._transport.read(0.0)
        except LinkError as error:
            raise self._build_lost_error(error) from None

    def _build_lost_error(self, error: LinkError) -> LinkError:
        fault = self._transport.describe_fault()
        return LinkError(f"sensor: {error}{f'; {fault}' if fault else ''}")

    def parse_spot(self, line: str) -> SpotReading | None:
        """Parse the answer to `spot`. Return None if the sensor detected no spot."""
        numbers = self._parse_numbers(line, "spot", 3)
        if numbers is None:
            return None
        x_m, y_m, sigma_m = (um_to_m(number) for number in numbers)
        return SpotReading(x_m, y_m, sigma_m)

    def parse_mirrors_rad(self, line: str) -> tuple[float, float] | None:
        """Parse the answer to `mirrors`, rad. Return None if the driver has no position outputs."""
        numbers = self._parse_numbers(line, "mirrors", 2)
        return None if numbers is None else (numbers[0], numbers[1])

    def parse_signals(self, line: str) -> tuple[str, ...]:
        """Parse the answer to `signals` as names of signals of a pixel.

        A sensor of spots records none.
        """
        word, *names = line.split() or [""]
        if word == "error" or (word == "signals" and names == ["none"]):
            return ()
        if word != "signals" or not set(names) <= set(PIXEL_SIGNALS):
            raise self._build_answer_error(line, f"'signals' and some of {', '.join(PIXEL_SIGNALS)}")
        return tuple(names)

    def parse_granted(self, line: str, count: int) -> None:
        """Check the answer to `record`, which repeats the number of samples."""
        if line.split() != ["record", str(count)]:
            raise self._build_answer_error(line, f"'record {count}'")

    def parse_samples(self, line: str) -> list[float] | None:
        """Parse the answer to `samples`. Return None while the recording is not complete."""
        count = len(line.split()) - 1
        return self._parse_numbers(line, "samples", max(1, count))

    def _parse_numbers(self, line: str, request: str, count: int) -> list[float] | None:
        word, *rest = line.split() or [""]
        if word == request and rest == ["none"]:
            return None
        try:
            numbers = [float(each) for each in rest]
        except ValueError:
            numbers = []
        if word != request or len(numbers) != count or not all(map(isfinite, numbers)):
            raise self._build_answer_error(line, f"'{request}' and {count} numbers, or '{request} none'")
        return numbers

    def _build_answer_error(self, received: str, expected: str) -> LinkError:
        return LinkError(
            f"sensor at {self.port}: received {received[:SHOWN_MAX]!r}, expected {expected}; is it a spot sensor?"
        )


class SensorReader:
    """Reads the sensor and keeps the board's lease while it waits."""

    def __init__(self, board: ExclusiveBoard, sensor: SpotSensorClient, clock: Clock) -> None:
        self._board, self.sensor, self._clock = board, sensor, clock
        self.signals: tuple[str, ...] = ()

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

    def open(self, records_pixels: bool = False) -> None:
        """Open the sensor's port, and ask for its signals where it is to record pixels.

        Raise InputError if the port does not exist or the sensor records no signal of a pixel, LinkError if no sensor
        answers.
        """
        self.sensor.open()
        self._query_spot()
        if records_pixels:
            self.signals = self.sensor.parse_signals(self.query("signals"))
            if not self.signals:
                expected = "a sensor that records signals of a pixel; this one measures only spots and mirrors"
                raise InputError("sensor.port", self.port, expected)

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

    def begin_recording(self, pixel: int, count: int, step_us: int) -> None:
        """Ask for a recording of `count` samples per signal from the next light on."""
        self.sensor.parse_granted(self.query(f"record {pixel} {count} {step_us}"), count)

    def read_recording(self, count: int) -> dict[str, FloatArray]:
        """Return the recorded signals, [count] each. Raise RefusedError if the sensor has seen no light."""
        return {name: self._read_signal(number, count) for number, name in enumerate(self.signals)}

    def _read_signal(self, number: int, count: int) -> FloatArray:
        until_s = self._clock.now_s() + LATE_MAX_S
        values: list[float] = []
        while len(values) < count:
            samples = self.sensor.parse_samples(self.query(f"samples {number} {len(values)}"))
            if samples is not None:
                values += samples
            elif self._clock.now_s() > until_s:
                raise RefusedError(f"sensor at {self.port}: recorded no light: does the beam reach the display?")
            else:
                self._board.wait(POLL_S)
        if len(values) > count:
            raise LinkError(f"sensor at {self.port}: {len(values)} samples, expected {count}")
        return np.array(values)


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
