"""Homing and first light: tables of steps that end with a disarmed board, or with the reason for a refusal.

Homing ends with centred mirrors. The gate stays off unless a spot power is given. The mirrors are observed by their
position outputs, by the spot, or not at all; without observation only the board's reports are checked, and the result
says so. First light emits single weak pulses at the centre after the steps of homing that need no light.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from optodrive.core.errors import InputError, RefusedError
from optodrive.core.quantity import format_quantity
from optodrive.device.config import Config
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard, max_spot_power_w
from optodrive.lab.commissioning.sensor import SensorReader
from optodrive.link.protocol.messages import INPUTS
from optodrive.link.protocol.quantisation import CENTRE_CODE
from optodrive.link.protocol.states import BoardState
from optodrive.link.session.board_view import get_fault_hint

INDICATOR_S = 2.0
READINGS_PER_SPOT = 3
"""Readings per spot, enough to reject one reflection."""
CLOCK_TOLERANCE = 1e-3
"""Relative tolerance between the clocks of host and board."""
INPUT_LABELS = {"interlock": ("open", "closed"), "key": ("off", "on"), "estop": ("released", "pressed")}
"""Labels of an input for 0 and 1."""
SAFE_LABELS = {"interlock": "closed", "key": "on", "estop": "released"}
STUCK_SHARE = 0.1
"""A mirror that moves less than this share of the commanded travel is stuck."""
OUTPUT_TOLERANCE, SPOT_TOLERANCE = 0.05, 0.1
"""Permitted relative error of position outputs and of spots; the calibration corrects it."""
ZERO_TOLERANCE_RAD = 2e-3
"""Permitted error of the position outputs at the centre."""
AXES = "xy"
DUTY_SHARE = 0.01
"""Default power as a share of the laser's: at less, the gate's readback of the reference board detects no light."""
PULSES_MAX = 100
PULSE_INTERVAL_S = 1.0


class HomingPosition(NamedTuple):
    """Commanded mirror angles, position outputs and spot position. The latter two are None without an instrument."""

    commanded_rad: tuple[float, float]
    output_rad: tuple[float, float] | None
    spot_m: tuple[float, float] | None


@dataclass(frozen=True)
class HomingResult:
    """Result of a successful step: message and details."""

    step: str
    message: str
    details: dict[str, object] = field(default_factory=dict)


Outcome = tuple[str, dict[str, object]]
"""Message and details of a step that succeeded."""


class Homing:
    """One run of the steps on one board.

    sensor_reader: None without a sensor; power_w: of spots, 0 to keep the gate off; acknowledge: a fault of the board
    """

    def __init__(
        self, board: ExclusiveBoard, sensor_reader: SensorReader | None, power_w: float, acknowledge: bool = False
    ) -> None:
        self._board, self._sensor_reader, self._power_w, self._acknowledge = board, sensor_reader, power_w, acknowledge
        self._code_rad = board.config.scanner.rad_per_code
        self._step = ""
        self._zero: HomingPosition | None = None
        self._ends: dict[int, tuple[HomingPosition, HomingPosition]] = {}

    def run(self, on_step: Callable[[HomingResult], None], steps: "tuple[Step, ...] | None" = None) -> None:
        """Run each step in order, by default all, and report its result. Raise OptodriveError if a step fails."""
        for name, step in STEPS if steps is None else steps:
            self._step = name
            on_step(HomingResult(name, *step(self)))

    def _require(self, is_met: bool, what: str, found: str, expected: str) -> None:
        if not is_met:
            raise RefusedError(f"home: {self._step}: {what}: got {found}, expected {expected}")

    # --- the steps ----------------------------------------------------------------------------------------------

    def check_link(self) -> Outcome:
        """Check that board and sensor answer."""
        self._board.connect()
        sensor = "no sensor"
        if self._sensor_reader is not None:
            self._sensor_reader.open()
            sensor = f"sensor at {self._sensor_reader.port}"
        port, uid = self._board.session.port, self._board.session.board.uid
        return f"board {uid} at {port}, {sensor}", {"board": port, "uid": uid}

    def check_status(self) -> Outcome:
        """Check that the board is DISARMED without a fault."""
        board = self._board.session.board
        if board.state == BoardState.FAULT and self._acknowledge:
            self._board.disarm()
        fault = f" {board.fault}: {get_fault_hint(board.fault)}" if board.fault else ""
        expected = "DISARMED; --acknowledge once the cause is gone"
        self._require(board.state == BoardState.DISARMED, "board", f"{board.state}{fault}", expected)
        return f"DISARMED, {board.temperature_c:g} °C", {"temperature_c": board.temperature_c}

    def check_inputs(self) -> Outcome:
        """Check that interlock, key and emergency stop are safe."""
        bits = self._board.session.board.inputs
        labels = {each: INPUT_LABELS[each][bits >> k & 1] for k, each in enumerate(INPUTS)}
        for each, label in labels.items():
            self._require(label == SAFE_LABELS[each], each, label, SAFE_LABELS[each])
        return ", ".join(f"{each} {word}" for each, word in labels.items()), dict(labels)

    def check_indicator(self) -> Outcome:
        """Arm the board and check that its indicator is on for two seconds before ARMED."""
        indicator_s = self._board.arm()
        # A shorter warning is a failure, though the board is ARMED.
        is_met, expected = indicator_s >= INDICATOR_S * (1.0 - CLOCK_TOLERANCE), f"at least {INDICATOR_S:g} s"
        self._require(is_met, "time from the request to ARMED", f"{indicator_s:.2f} s", expected)
        return f"indicator on for {indicator_s:.2f} s, ARMED", {"indicator_s": round(indicator_s, 3)}

    def move_to_zero(self) -> Outcome:
        """Move the mirrors to the centre and check the position outputs there."""
        self._zero = position = self._measure_at(CENTRE_CODE, CENTRE_CODE)
        expected = f"0 ± {format_quantity(ZERO_TOLERANCE_RAD, 'rad')} at the centre"
        for axis, output_rad in zip(AXES, position.output_rad or (), strict=False):
            what, found = f"position output of mirror {axis}", format_quantity(output_rad, "rad")
            self._require(abs(output_rad) <= ZERO_TOLERANCE_RAD, what, found, expected)
        return _describe_position(position), _position_details(position)

    def check_travel(self, axis: int) -> Outcome:
        """Move mirror x (0) or y (1) to both ends of the display and check its travel."""
        high, low = (self._measure_at(*self._end_codes(axis, sign)) for sign in (1, -1))
        self._ends[axis] = high, low
        commanded_rad = high.commanded_rad[axis] - low.commanded_rad[axis]
        if high.output_rad is not None:
            # Here only whether it moves; axis, sign and scale are the next step's, which can compare both axes.
            self._require_motion(axis, _difference(high.output_rad, low.output_rad, axis), commanded_rad, "rad")
        if high.spot_m is not None:
            # A mirror turns the beam by twice its own angle.
            commanded_m = 2.0 * self._board.config.scanner.focal_length_m * commanded_rad
            own_m, other_m = (_difference(high.spot_m, low.spot_m, each) for each in (axis, 1 - axis))
            self._require_motion(axis, own_m, commanded_m, "m")
            tolerance_m = SPOT_TOLERANCE * commanded_m
            self._require(
                abs(own_m - commanded_m) <= tolerance_m and abs(other_m) <= tolerance_m,
                f"spot over the travel of mirror {AXES[axis]}",
                f"{own_m:.4f} m along {AXES[axis]}, {other_m:.4f} m along {AXES[1 - axis]}",
                f"{commanded_m:.4f} ± {tolerance_m:.4f} m along {AXES[axis]}: scanner.swap_axes, invert_x or invert_y, "
                "or another lens?",
            )
        details: dict[str, object] = {"plus": _position_details(high), "minus": _position_details(low)}
        return f"±{commanded_rad / 2:.4f} rad, {_describe_evidence(high)}", details

    def check_readback(self) -> Outcome:
        """Check that the position outputs follow the commands: axis, direction and scale."""
        if self._zero is None or self._zero.output_rad is None:
            return "no position outputs: not checked", {"checked": False}
        for axis, (high, low) in self._ends.items():
            commanded_rad = high.commanded_rad[axis] - low.commanded_rad[axis]
            own_rad, other_rad = (_difference(high.output_rad, low.output_rad, each) for each in (axis, 1 - axis))
            tolerance_rad, what = OUTPUT_TOLERANCE * commanded_rad, f"position output of mirror {AXES[axis]}"
            inverted = ", inverted" if abs(own_rad + commanded_rad) <= tolerance_rad else ""
            self._require(
                abs(own_rad - commanded_rad) <= tolerance_rad,
                f"{what} over its travel",
                f"{own_rad:.5f} rad{inverted}",
                f"{commanded_rad:.5f} ± {tolerance_rad:.5f} rad",
            )
            what = f"position output of mirror {AXES[1 - axis]} while {AXES[axis]} moves"
            expected = f"0 ± {tolerance_rad:.5f} rad"
            self._require(abs(other_rad) <= tolerance_rad, what, f"{other_rad:.5f} rad", expected)
        return f"both mirrors follow within {OUTPUT_TOLERANCE:.0%}", {"checked": True}

    def return_to_zero(self) -> Outcome:
        """Return the mirrors to the centre with the gate off, and disarm."""
        self._board.move_to(CENTRE_CODE, CENTRE_CODE)
        self._board.disarm()
        return "mirrors at the centre, DISARMED", {"board": BoardState.DISARMED}

    # --- measurements -------------------------------------------------------------------------------------------

    def _measure_at(self, x_code: int, y_code: int) -> HomingPosition:
        self._board.move_to(x_code, y_code)
        commanded_rad = (x_code - CENTRE_CODE) * self._code_rad, (y_code - CENTRE_CODE) * self._code_rad
        # Nobody measures, but a person may look at the spot.
        if self._sensor_reader is None:
            if self._power_w:
                self._board.fire_spot(x_code, y_code, self._power_w)
            return HomingPosition(commanded_rad, None, None)
        output_rad, spot_m = self._sensor_reader.read_mirrors_rad(), None
        if self._power_w:
            reading = self._sensor_reader.read_spot(x_code, y_code, self._power_w, READINGS_PER_SPOT)
            if reading is None:
                place = f"with the mirrors at {commanded_rad[0]:.4f}, {commanded_rad[1]:.4f} rad"
                expected = "a spot: is it covered, or too dim?"
                raise RefusedError(
                    f"home: spot: sensor at {self._sensor_reader.port} {place}: got no spot, expected {expected}"
                )
            spot_m = reading.x_m, reading.y_m
        return HomingPosition(commanded_rad, output_rad, spot_m)

    def _end_codes(self, axis: int, sign: int) -> tuple[int, int]:
        codes = [CENTRE_CODE, CENTRE_CODE]
        codes[axis] += sign * self._board.half_travel_codes[axis]
        return codes[0], codes[1]

    def _require_motion(self, axis: int, moved: float, commanded: float, unit: str) -> None:
        what = f"mirror {AXES[axis]}, commanded {commanded:.4f} {unit} from end to end,"
        found, expected = f"does not move: {moved:.4f} {unit}", f"{commanded:.4f} {unit}"
        self._require(abs(moved) >= STUCK_SHARE * commanded, what, found, expected)


def _difference(high: tuple[float, float] | None, low: tuple[float, float] | None, axis: int) -> float:
    return 0.0 if high is None or low is None else high[axis] - low[axis]


def _describe_evidence(position: HomingPosition) -> str:
    instruments = [
        word for word, reading in (("position outputs", position.output_rad), ("spot", position.spot_m)) if reading
    ]
    return f"observed by {' and '.join(instruments)}" if instruments else "executed; no instrument observes the mirrors"


def _describe_position(position: HomingPosition) -> str:
    parts = (
        []
        if position.output_rad is None
        else [f"outputs {position.output_rad[0]:.5f}, {position.output_rad[1]:.5f} rad"]
    )
    if position.spot_m is not None:
        parts.append(f"spot {position.spot_m[0] * 1e3:.3f}, {position.spot_m[1] * 1e3:.3f} mm")
    return "; ".join(parts) or "executed; no instrument observes the mirrors"


def _position_details(position: HomingPosition) -> dict[str, object]:
    return {"commanded_rad": position.commanded_rad, "output_rad": position.output_rad, "spot_m": position.spot_m}


Step = tuple[str, Callable[[Homing], Outcome]]
"""Name of a step and its function."""

DARK_STEPS: tuple[Step, ...] = (
    ("link", Homing.check_link),
    ("status", Homing.check_status),
    ("inputs", Homing.check_inputs),
    ("indicator", Homing.check_indicator),
)
"""The first steps, without light in any case; they end with an armed board."""

STEPS: tuple[Step, ...] = (
    *DARK_STEPS,
    ("zero", Homing.move_to_zero),
    ("travel x", lambda homing: homing.check_travel(0)),
    ("travel y", lambda homing: homing.check_travel(1)),
    ("readback", Homing.check_readback),
    ("zero again", Homing.return_to_zero),
)
"""Steps in order; each one starts from the result of the step before."""


def default_power_w(config: Config) -> float:
    """Return the lowest power that is emitted and that the reference board's readback detects, at most a spot's, W."""
    return min(DUTY_SHARE * config.laser.max_power_w, max_spot_power_w(config))


def emit_first_light(
    board: ExclusiveBoard, power_w: float, pulses: int, acknowledge: bool, on_step: Callable[[HomingResult], None]
) -> None:
    """Check link, state, inputs and indicator, centre the mirrors, emit the pulses one per second, and disarm.

    Raises InputError for a power beyond that of a spot or a number of pulses outside 1 to PULSES_MAX, RefusedError for
    a failed check, and errors of the board as ExclusiveBoard.
    """
    if not 1 <= pulses <= PULSES_MAX:
        raise InputError("--pulses", pulses, f"1 to {PULSES_MAX}")
    # Not the steps that move the mirrors over the display: the first light is to be where a person expects it.
    Homing(board, None, 0.0, acknowledge).run(on_step, DARK_STEPS)
    board.move_to(CENTRE_CODE, CENTRE_CODE)
    for number in range(1, pulses + 1):
        if number > 1:
            board.wait(PULSE_INTERVAL_S)
        board.fire_spot(CENTRE_CODE, CENTRE_CODE, power_w)
        on_step(HomingResult("light", f"pulse {number} of {pulses} executed", {"pulse": number}))
    board.disarm()
    on_step(HomingResult("end", "gate off, DISARMED", {"board": str(board.session.board.state)}))
