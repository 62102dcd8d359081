"""Who finds the spot: the sensor, or a person who moves it onto a mark."""

from collections.abc import Callable
from queue import Empty, SimpleQueue

import numpy as np

from optodrive.core.errors import InputError, RefusedError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.units import um_to_m
from optodrive.device.config import build_pixel_layout
from optodrive.lab.calibration.field_fit import FieldFit
from optodrive.lab.calibration.spots import MeasuredSpots
from optodrive.lab.commissioning.exclusive_board import HeldBoard
from optodrive.lab.commissioning.predicted_error import display_codes
from optodrive.lab.commissioning.session_file import Row
from optodrive.lab.commissioning.spot_reader import Eyes

SIDE = 11
"""Places a side that a sensor may be asked about."""
BEYOND_PIXELS_M = 1.5e-3
BLINK_S = 0.1
"""Darkness between two flashes for a person's eye."""
NUDGE_MAX_UM = 5000.0
HELP = "'dx dy' in µm moves the spot, an empty line says that it lies on the mark, 's' skips this pixel"


class SensorLook:
    """A sensor looks, a few times at each place."""

    def __init__(self, held: HeldBoard, eyes: Eyes, power_w: float, readings: int) -> None:
        self._eyes, self._power_w, self._readings = eyes, power_w, readings
        self._codes = np.rint(held.within(display_codes(held.config, BEYOND_PIXELS_M, SIDE)))
        self.name = f"sensor at {eyes.port}"
        self.unseen = f"{self.name} sees no spot, expected one: is it covered, or {power_w * 1e3:g} mW too dim?"

    def candidates(self, fit: FieldFit) -> FloatArray:
        """A grid over the display and a little more."""
        return self._codes

    def start(self) -> list[int]:
        """Corners, edges and the middle."""
        ends = (0, SIDE // 2, SIDE - 1)
        return [row * SIDE + column for row in ends for column in ends]

    def places(self, spots: MeasuredSpots) -> IntArray:
        """By the codes they were sent to."""
        return _same(self._codes, np.column_stack([spots.x_code, spots.y_code]))

    def measure(self, place: int, x_code: int, y_code: int) -> Row | None:
        """Light it, and take the mean of what is seen."""
        seen = self._eyes.spot(x_code, y_code, self._power_w, self._readings)
        return None if seen is None else Row(x_code, y_code, seen.x_m, seen.y_m)


class NudgeLook:
    """A person looks: the spot is to be moved onto the middle of a pixel, whose place is known.

    lines: what the person types, None at its end; say: words for the person.
    """

    name = "spots moved by hand"
    unseen = "skipped, expected a spot moved onto its mark"

    def __init__(
        self, held: HeldBoard, power_w: float, lines: "SimpleQueue[str | None]", say: Callable[[str], None]
    ) -> None:
        self._held, self._power_w, self._lines, self._say = held, power_w, lines, say
        self._layout = build_pixel_layout(held.config.display)
        scanner = held.config.scanner
        self._code_m = 2.0 * scanner.focal_length_m * scanner.rad_per_code

    def candidates(self, fit: FieldFit) -> FloatArray:
        """The middle of every pixel, where the field so far leads the beam to it; no farther than the board goes."""
        return self._held.within(np.column_stack(fit.field.codes(self._layout.x_m, self._layout.y_m)))

    def start(self) -> list[int]:
        """Pixels nearest to the corners, edges and middle of the lattice."""
        x_m, y_m = self._layout.x_m, self._layout.y_m
        places = [
            int(np.argmin(np.hypot(x_m - x * np.abs(x_m).max(), y_m - y * np.abs(y_m).max())))
            for y in (-1, 0, 1)
            for x in (-1, 0, 1)
        ]
        return list(dict.fromkeys(places))

    def places(self, spots: MeasuredSpots) -> IntArray:
        """By the pixels they lie on."""
        return _same(np.column_stack([self._layout.x_m, self._layout.y_m]), np.column_stack([spots.x_m, spots.y_m]))

    def measure(self, place: int, x_code: int, y_code: int) -> Row | None:
        """Flash the spot until the person says that it lies on the mark."""
        x_m, y_m = float(self._layout.x_m[place]), float(self._layout.y_m[place])
        self._say(f"pixel {place}, {x_m * 1e3:+.2f} {y_m * 1e3:+.2f} mm: {HELP}")
        while True:
            line = self._line(x_code, y_code)
            if not line:
                return Row(x_code, y_code, x_m, y_m)
            if line == "s":
                return None
            moved = _nudge_um(line)
            if moved is None:
                self._say(f"got {line!r}, expected {HELP}; no more than {NUDGE_MAX_UM:g} µm at a time")
                continue
            x_to, y_to = (
                code + round(um_to_m(way) / self._code_m) for code, way in zip((x_code, y_code), moved, strict=True)
            )
            try:
                self._held.check_range(x_to, y_to)
            except InputError as error:
                self._say(str(error))
                continue
            x_code, y_code = x_to, y_to

    def _line(self, x_code: int, y_code: int) -> str:
        """What the person types, the spot flashing meanwhile."""
        while True:
            try:
                line = self._lines.get_nowait()
            except Empty:
                self._held.light(x_code, y_code, self._power_w)
                self._held.wait(BLINK_S)
                continue
            if line is None:
                raise RefusedError("calibrate: nobody answers any more (end of input); what was measured is kept")
            return line.strip()


def _same(known: FloatArray, given: FloatArray) -> IntArray:
    """Row of known [k, 2] that each row of given [n, 2] repeats, -1 where none does."""
    same = np.all(np.isclose(given[:, None], known[None], rtol=0.0, atol=1e-9), axis=2)
    return np.where(same.any(axis=1), same.argmax(axis=1), -1)


def _nudge_um(line: str) -> tuple[float, float] | None:
    try:
        dx_um, dy_um = (float(each) for each in line.split())
    except ValueError:
        return None
    return (dx_um, dy_um) if max(abs(dx_um), abs(dy_um)) <= NUDGE_MAX_UM else None
