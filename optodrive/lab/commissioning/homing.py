"""Homing: a table of steps that ends with the mirrors in their middle and the board disarmed, or with a reason.

All is dark unless a spot's power is given. Mirrors are seen by their position outputs, by the spot, or not at all: then
only the board's word is checked, and the answer says so.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import RefusedError
from optodrive.device.config import build_pixel_layout
from optodrive.lab.commissioning.exclusive_board import HeldBoard
from optodrive.lab.commissioning.spot_reader import Eyes
from optodrive.link.protocol.messages import INPUTS
from optodrive.link.protocol.quantisation import CENTRE_CODE
from optodrive.link.session.fault_hints import get_fault_hint

INDICATOR_S = 2.0
READINGS = 3
"""Of each spot: one reflection among them does not count."""
CLOCKS_AGREE = 1e-3
"""Host and board count seconds alike within this share."""
TRAVEL_LEAST_M = 3e-3
SAFE_WORDS = {"interlock": ("open", "closed"), "key": ("off", "on"), "estop": ("released", "pressed")}
"""Words for an input that is 0 and 1."""
SAFE = {"interlock": "closed", "key": "on", "estop": "released"}
STANDS = 0.1
"""A mirror that goes less than this share of its way does not move."""
OUTPUT_SHARE, SPOT_SHARE = 0.05, 0.1
"""Position outputs and spots may be off by such a share of the way: what the calibration is there for."""
ZERO_RAD = 2e-3
"""Position outputs may be off by so much in the middle."""
AXES = "xy"


class Place(NamedTuple):
    """Where mirrors were sent, rad, and what was seen there: outputs, rad, and spot, m; None where nothing looks."""

    sent_rad: tuple[float, float]
    output_rad: tuple[float, float] | None
    spot_m: tuple[float, float] | None


@dataclass(frozen=True)
class Done:
    """A step that went well, in words and figures."""

    step: str
    words: str
    figures: dict[str, object] = field(default_factory=dict)


class Homing:
    """One run of the steps on one board.

    eyes: None without a sensor; power_w: of spots, 0 in the dark; acknowledge: a fault that the board still shows
    """

    def __init__(self, held: HeldBoard, eyes: Eyes | None, power_w: float, acknowledge: bool = False) -> None:
        self._held, self._eyes, self._power_w, self._acknowledge = held, eyes, power_w, acknowledge
        self._code_rad = held.config.scanner.rad_per_code
        self._zero: Place | None = None
        self._ends: dict[int, tuple[Place, Place]] = {}

    def run(self, tell: Callable[[Done], None]) -> None:
        """Do every step of the table in order, telling each; an OptodriveError names what stops it."""
        for name, step in STEPS:
            tell(step(self, name))

    # --- the steps ----------------------------------------------------------------------------------------------

    def link(self, name: str) -> Done:
        """Board and sensor answer."""
        self._held.connect()
        if self._eyes is not None:
            self._eyes.open()
        board, sensor = self._held.session, "no sensor" if self._eyes is None else f"sensor at {self._eyes.port}"
        uid = board.board.uid
        return Done(name, f"board {uid} at {board.port}, {sensor}", {"board": board.port, "uid": uid})

    def status(self, name: str) -> Done:
        """The board waits, without a fault."""
        board = self._held.session.board
        if board.state == "FAULT" and self._acknowledge:
            self._held.disarm()
        if board.state != "DISARMED":
            fault = f" {board.fault}: {get_fault_hint(board.fault)}" if board.fault else ""
            raise _refused(name, "board", f"{board.state}{fault}", "DISARMED; --acknowledge once the cause is gone")
        return Done(name, f"DISARMED, {board.temperature_c:g} °C", {"temperature_c": board.temperature_c})

    def inputs(self, name: str) -> Done:
        """Interlock, key and emergency stop are safe."""
        bits = self._held.session.board.inputs
        found = {each: SAFE_WORDS[each][bits >> k & 1] for k, each in enumerate(INPUTS)}
        for each, word in found.items():
            if word != SAFE[each]:
                raise _refused(name, each, word, SAFE[each])
        return Done(name, ", ".join(f"{each} {word}" for each, word in found.items()), dict(found))

    def indicator(self, name: str) -> Done:
        """The board arms, and warns for two seconds before it is ARMED."""
        lit_s = self._held.arm()
        if lit_s < INDICATOR_S * (1.0 - CLOCKS_AGREE):
            raise _refused(name, "time from the order to ARMED", f"{lit_s:.2f} s", f"at least {INDICATOR_S:g} s")
        return Done(name, f"lit for {lit_s:.2f} s, ARMED", {"lit_s": round(lit_s, 3)})

    def zero(self, name: str) -> Done:
        """Mirrors to their middle."""
        self._zero = place = self._look(CENTRE_CODE, CENTRE_CODE)
        if place.output_rad is not None:
            for axis in range(2):
                off_rad = place.output_rad[axis]
                if abs(off_rad) > ZERO_RAD:
                    expected = f"0 ± {ZERO_RAD:g} rad in the middle"
                    raise _refused(name, f"position output of mirror {AXES[axis]}", f"{off_rad:.5f} rad", expected)
        return Done(name, _seen(place), _figures(place))

    def travel_x(self, name: str) -> Done:
        """Mirror x to both ends of the display."""
        return self._travel(name, 0)

    def travel_y(self, name: str) -> Done:
        """Mirror y to both ends of the display."""
        return self._travel(name, 1)

    def readback(self, name: str) -> Done:
        """Position outputs follow: the right mirror, the right way, as far as sent."""
        if self._zero is None or self._zero.output_rad is None:
            return Done(name, "no position outputs: not checked", {"checked": False})
        for axis, (high, low) in self._ends.items():
            sent_rad = high.sent_rad[axis] - low.sent_rad[axis]
            own_rad, other_rad = (_between(high.output_rad, low.output_rad, each) for each in (axis, 1 - axis))
            within = f"{sent_rad:.5f} ± {OUTPUT_SHARE * sent_rad:.5f} rad"
            what = f"position output of mirror {AXES[axis]}"
            if abs(own_rad + sent_rad) <= OUTPUT_SHARE * sent_rad:
                raise _refused(name, f"{what} over its way", f"{own_rad:.5f} rad, inverted", within)
            if abs(own_rad - sent_rad) > OUTPUT_SHARE * sent_rad:
                raise _refused(name, f"{what} over its way", f"{own_rad:.5f} rad", within)
            if abs(other_rad) > OUTPUT_SHARE * sent_rad:
                other = f"position output of mirror {AXES[1 - axis]} while {AXES[axis]} goes"
                raise _refused(name, other, f"{other_rad:.5f} rad", f"0 ± {OUTPUT_SHARE * sent_rad:.5f} rad")
        return Done(name, f"both mirrors follow within {OUTPUT_SHARE:.0%}", {"checked": True})

    def end(self, name: str) -> Done:
        """Back to the middle in the dark, and disarmed."""
        self._held.go(CENTRE_CODE, CENTRE_CODE)
        self._held.disarm()
        return Done(name, "mirrors in the middle, DISARMED", {"board": "DISARMED"})

    # --- what they share ----------------------------------------------------------------------------------------

    def _look(self, x_code: int, y_code: int) -> Place:
        self._held.go(x_code, y_code)
        sent_rad = (x_code - CENTRE_CODE) * self._code_rad, (y_code - CENTRE_CODE) * self._code_rad
        if self._eyes is None:
            if self._power_w:
                self._held.light(x_code, y_code, self._power_w)
            return Place(sent_rad, None, None)
        output_rad = self._eyes.mirrors_rad()
        seen = self._eyes.spot(x_code, y_code, self._power_w, READINGS) if self._power_w else None
        spot_m = None if seen is None else (seen.x_m, seen.y_m)
        if self._power_w and spot_m is None:
            sent = f"with the mirrors at {sent_rad[0]:.4f}, {sent_rad[1]:.4f} rad"
            raise _refused(
                "spot", f"sensor at {self._eyes.port} {sent}", "no spot", "a spot: is it covered, or too dim?"
            )
        return Place(sent_rad, output_rad, spot_m)

    def _travel(self, name: str, axis: int) -> Done:
        high, low = (self._look(*self._end(axis, sign)) for sign in (1, -1))
        self._ends[axis] = high, low
        sent_rad = high.sent_rad[axis] - low.sent_rad[axis]
        if high.output_rad is not None:
            self._check_stands(name, axis, _between(high.output_rad, low.output_rad, axis), sent_rad, "rad")
        if high.spot_m is not None:
            sent_m = 2.0 * self._held.config.scanner.focal_length_m * sent_rad
            own_m, other_m = (_between(high.spot_m, low.spot_m, each) for each in (axis, 1 - axis))
            self._check_stands(name, axis, own_m, sent_m, "m")
            within, what = f"{sent_m:.4f} ± {SPOT_SHARE * sent_m:.4f} m", f"spot while mirror {AXES[axis]} goes its way"
            if abs(own_m - sent_m) > SPOT_SHARE * sent_m or abs(other_m) > SPOT_SHARE * sent_m:
                went = f"{own_m:.4f} m along {AXES[axis]}, {other_m:.4f} m along {AXES[1 - axis]}"
                raise _refused(name, what, went, f"{within} along {AXES[axis]}: axes mirrored, swapped, another lens?")
        words = f"±{sent_rad / 2:.4f} rad, {_how_seen(high)}"
        return Done(name, words, {"plus": _figures(high), "minus": _figures(low)})

    def _end(self, axis: int, sign: int) -> tuple[int, int]:
        layout = build_pixel_layout(self._held.config.display)
        reach_m = max(float(np.abs((layout.x_m, layout.y_m)[axis]).max()), TRAVEL_LEAST_M)
        way = round(reach_m / (2.0 * self._held.config.scanner.focal_length_m * self._code_rad))
        codes = [CENTRE_CODE, CENTRE_CODE]
        codes[axis] += sign * way
        return codes[0], codes[1]

    def _check_stands(self, name: str, axis: int, moved: float, sent: float, unit: str) -> None:
        if abs(moved) < STANDS * sent:
            what = f"mirror {AXES[axis]}, sent {sent:.4f} {unit} from end to end,"
            raise _refused(name, what, f"does not move: {moved:.4f} {unit}", f"{sent:.4f} {unit}")


def _refused(step: str, what: str, value: str, expected: str) -> RefusedError:
    return RefusedError(f"home: {step}: {what}: got {value}, expected {expected}")


def _between(high: tuple[float, float] | None, low: tuple[float, float] | None, axis: int) -> float:
    return 0.0 if high is None or low is None else high[axis] - low[axis]


def _how_seen(place: Place) -> str:
    seen = [word for word, there in (("position outputs", place.output_rad), ("spot", place.spot_m)) if there]
    return f"seen by {' and '.join(seen)}" if seen else "executed; nothing here sees the mirrors"


def _seen(place: Place) -> str:
    words = [] if place.output_rad is None else [f"outputs {place.output_rad[0]:.5f}, {place.output_rad[1]:.5f} rad"]
    if place.spot_m is not None:
        words.append(f"spot {place.spot_m[0] * 1e3:.3f}, {place.spot_m[1] * 1e3:.3f} mm")
    return "; ".join(words) or "executed; nothing here sees the mirrors"


def _figures(place: Place) -> dict[str, object]:
    return {"sent_rad": place.sent_rad, "output_rad": place.output_rad, "spot_m": place.spot_m}


STEPS: tuple[tuple[str, Callable[[Homing, str], Done]], ...] = (
    ("link", Homing.link),
    ("status", Homing.status),
    ("inputs", Homing.inputs),
    ("indicator", Homing.indicator),
    ("zero", Homing.zero),
    ("travel x", Homing.travel_x),
    ("travel y", Homing.travel_y),
    ("readback", Homing.readback),
    ("zero again", Homing.end),
)
"""In order; each begins in what the one before it left."""
