"""Spot locators: a sensor, or a person who moves the spot onto a mark."""

from collections.abc import Callable
from queue import Empty, SimpleQueue

import numpy as np

from optodrive.core.errors import InputError, RefusedError
from optodrive.core.quantity import format_quantity, um_to_m
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.device.config import build_pixel_layout
from optodrive.lab.calibration.field_fit import FieldFit
from optodrive.lab.calibration.spots import MeasuredSpots
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.lab.commissioning.measurement_loop import SpotRow, build_code_grid
from optodrive.lab.commissioning.sensor import SensorReader

GRID_SIDE = 11
"""Candidate positions per side for a sensor."""
GRID_MARGIN_M = 1.5e-3
BLINK_S = 0.1
"""Gate-off time between two flashes, visible to a person."""
NUDGE_MAX_UM = 5000.0
HELP = "'dx dy' in µm moves the spot, an empty line confirms that it is on the mark, 's' skips this pixel"


class SensorLocator:
    """Locates spots with a sensor, several readings per position."""

    def __init__(self, board: ExclusiveBoard, sensor_reader: SensorReader, power_w: float, readings: int) -> None:
        self._sensor_reader, self._power_w, self._readings = sensor_reader, power_w, readings
        # The whole grid shrinks to the board's range: places that are clipped one by one may get the same codes, and
        # one that cannot be told from another would never count as measured.
        grid = build_code_grid(board.config, GRID_MARGIN_M, GRID_SIDE)
        low, high = grid.min(axis=0), grid.max(axis=0)
        self._codes: FloatArray = np.rint(
            board.clip_codes(low) + (grid - low) / (high - low) * (board.clip_codes(high) - board.clip_codes(low))
        )
        self.name = f"sensor at {sensor_reader.port}"
        self.not_found_message = (
            f"{self.name} sees no spot, expected one: is it covered, or is {format_quantity(power_w, 'W')} too dim?"
        )

    def candidate_codes(self, fit: FieldFit) -> FloatArray:
        """Return a grid over the display and a margin."""
        return self._codes

    def initial_places(self) -> list[int]:
        """Return corners, edges and centre."""
        ends = (0, GRID_SIDE // 2, GRID_SIDE - 1)
        return [row * GRID_SIDE + column for row in ends for column in ends]

    def match_places(self, spots: MeasuredSpots) -> IntArray:
        """Match spots by their commanded codes."""
        return _match_rows(self._codes, np.column_stack([spots.x_code, spots.y_code]))

    def measure(self, place: int, x_code: int, y_code: int) -> SpotRow | None:
        """Measure a position as the robust mean of several readings."""
        reading = self._sensor_reader.read_spot(x_code, y_code, self._power_w, self._readings)
        return None if reading is None else SpotRow(x_code, y_code, reading.x_m, reading.y_m)


class ManualLocator:
    """Locates spots with a person, who moves the spot onto the centre of a pixel of known position.

    input_lines: typed lines, None at the end of input; show: shows a message to the person
    """

    name = "spots moved by hand"
    not_found_message = "skipped, expected a spot moved onto its mark"

    def __init__(
        self, board: ExclusiveBoard, power_w: float, input_lines: "SimpleQueue[str | None]", show: Callable[[str], None]
    ) -> None:
        self._board, self._power_w, self._input_lines, self._show = board, power_w, input_lines, show
        self._layout = build_pixel_layout(board.config.display)
        scanner = board.config.scanner
        self._code_m = 2.0 * scanner.focal_length_m * scanner.rad_per_code

    def candidate_codes(self, fit: FieldFit) -> FloatArray:
        """Return the codes of each pixel's centre by the present fit, clipped to the board's range."""
        return self._board.clip_codes(np.column_stack(fit.field.codes(self._layout.x_m, self._layout.y_m)))

    def initial_places(self) -> list[int]:
        """Return the pixels nearest to the corners, edges and centre of the lattice."""
        x_m, y_m = self._layout.x_m, self._layout.y_m
        places = [
            int(np.argmin(np.hypot(x_m - x * np.abs(x_m).max(), y_m - y * np.abs(y_m).max())))
            for y in (-1, 0, 1)
            for x in (-1, 0, 1)
        ]
        return list(dict.fromkeys(places))

    def match_places(self, spots: MeasuredSpots) -> IntArray:
        """Match spots by their pixel."""
        return _match_rows(
            np.column_stack([self._layout.x_m, self._layout.y_m]), np.column_stack([spots.x_m, spots.y_m])
        )

    def measure(self, place: int, x_code: int, y_code: int) -> SpotRow | None:
        """Flash the spot until the person confirms that it is on the mark."""
        x_m, y_m = float(self._layout.x_m[place]), float(self._layout.y_m[place])
        self._show(f"pixel {place}, {x_m * 1e3:+.2f} {y_m * 1e3:+.2f} mm: {HELP}")
        while True:
            line = self._read_line(x_code, y_code)
            if not line:
                return SpotRow(x_code, y_code, x_m, y_m)
            if line == "s":
                return None
            nudge_um = _parse_nudge_um(line)
            if nudge_um is None:
                self._show(f"got {line!r}, expected {HELP}; no more than {NUDGE_MAX_UM:g} µm at a time")
                continue
            new_x_code, new_y_code = (
                code + round(um_to_m(offset_um) / self._code_m)
                for code, offset_um in zip((x_code, y_code), nudge_um, strict=True)
            )
            try:
                # Before the light: the spot stays where it was, and the person is told why.
                self._board.check_range(new_x_code, new_y_code)
            except InputError as error:
                self._show(str(error))
                continue
            x_code, y_code = new_x_code, new_y_code

    def _read_line(self, x_code: int, y_code: int) -> str:
        """Return the next typed line. Flash the spot while waiting. Raise RefusedError at the end of input."""
        while True:
            try:
                line = self._input_lines.get_nowait()
            except Empty:
                self._board.fire_spot(x_code, y_code, self._power_w)
                self._board.wait(BLINK_S)
                continue
            if line is None:
                raise RefusedError("calibrate: end of input; the measured spots are kept")
            return line.strip()


def _match_rows(known: FloatArray, given: FloatArray) -> IntArray:
    """Return for each row of given [n, 2] the equal row of known [k, 2], -1 if there is none."""
    equal = np.all(np.isclose(given[:, None], known[None], rtol=0.0, atol=1e-9), axis=2)
    return np.where(equal.any(axis=1), equal.argmax(axis=1), -1)


def _parse_nudge_um(line: str) -> tuple[float, float] | None:
    try:
        dx_um, dy_um = (float(each) for each in line.split())
    except ValueError:
        return None
    return (dx_um, dy_um) if max(abs(dx_um), abs(dy_um)) <= NUDGE_MAX_UM else None
