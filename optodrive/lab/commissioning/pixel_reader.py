"""Recordings of one pixel from the sensor, with exclusive access to the board."""

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError, RefusedError
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.lab.commissioning.spot_reader import SpotReader

LATE_MAX_S = 2.0
"""Time after the last sample in which the recording must be complete."""
POLL_S = 0.05


class PixelReader:
    """Reads recordings that begin before the first light after a request. The board keeps its lease meanwhile."""

    def __init__(self, board: ExclusiveBoard, reader: SpotReader, clock: Clock) -> None:
        self._board, self._reader, self._sensor, self._clock = board, reader, reader.sensor, clock
        self.signals: tuple[str, ...] = ()

    def open(self) -> None:
        """Open the sensor's port and ask for its signals. Raise InputError if it records none of a pixel."""
        self._reader.open()
        self.signals = self._sensor.parse_signals(self._reader.query("signals"))
        if not self.signals:
            expected = "a sensor that records signals of a pixel; this one measures only spots and mirrors"
            raise InputError("sensor.port", self._sensor.port, expected)

    def begin(self, pixel: int, count: int, step_us: int) -> None:
        """Ask for a recording of `count` samples per signal from the next light on."""
        self._sensor.parse_granted(self._reader.query(f"record {pixel} {count} {step_us}"), count)

    def read(self, count: int) -> dict[str, FloatArray]:
        """Return the recorded signals, [count] each. Raise RefusedError if the sensor has seen no light."""
        return {name: self._read_signal(number, count) for number, name in enumerate(self.signals)}

    def _read_signal(self, number: int, count: int) -> FloatArray:
        until_s = self._clock.now_s() + LATE_MAX_S
        values: list[float] = []
        while len(values) < count:
            samples = self._sensor.parse_samples(self._reader.query(f"samples {number} {len(values)}"))
            if samples is not None:
                values += samples
            elif self._clock.now_s() > until_s:
                raise RefusedError(
                    f"sensor at {self._sensor.port}: recorded no light: does the beam reach the display?"
                )
            else:
                self._board.wait(POLL_S)
        if len(values) > count:
            raise LinkError(f"sensor at {self._sensor.port}: {len(values)} samples, expected {count}")
        return np.array(values)
