"""Non-blocking client of a spot sensor: one request line, one answer line. See SENSOR.md."""

from math import isfinite
from typing import NamedTuple

from optodrive.core.errors import LinkError
from optodrive.core.units import um_to_m
from optodrive.lab.recording.storage import MIRROR_SIGNALS, SIGNALS
from optodrive.link.transport.base import Transport

PIXEL_SIGNALS = tuple(name for name in SIGNALS if name not in MIRROR_SIGNALS)
LINE_MAX = 1024
SHOWN_MAX = 64
"""Characters of an invalid answer that a message shows."""


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
