"""The simulated mirrors: where they stand at a time, and what their position outputs say of it."""

from math import cos, exp, sin, sqrt
from typing import NamedTuple

import numpy as np

from optodrive.device.config import HALF_RANGE_CODES, Config
from optodrive.device.gate_timing import build_servo
from optodrive.device.servo import Servo

CENTRE_CODE = HALF_RANGE_CODES + 1
OUTPUT_NOISE_RAD = 1e-5
FORGOTTEN_S = 0.5
"""A move so long ago is over."""


class Move(NamedTuple):
    """From at_s on, by so many radians on each axis."""

    at_s: float
    way_rad: tuple[float, float]


class Mirrors:
    """Two mirrors that follow codes as the configured servo does; angles are the servo's own, nominal.

    Moves that overlap are added up: between two moves that is not quite the servo, when they are over it is.
    """

    def __init__(self, config: Config, seed: int | np.random.SeedSequence) -> None:
        self._servo = build_servo(config.scanner)
        self._code_rad = config.scanner.rad_per_code
        self._random = np.random.default_rng(seed)
        self._from_rad = (0.0, 0.0)
        self._asked_rad = (0.0, 0.0)
        self._moves: list[Move] = []
        self._stuck_rad: dict[int, float] = {}
        self.inverted = False

    def go(self, x_code: int, y_code: int, at_us: int) -> None:
        """The board sends them somewhere else."""
        asked_rad = (x_code - CENTRE_CODE) * self._code_rad, (y_code - CENTRE_CODE) * self._code_rad
        if asked_rad == self._asked_rad:
            return
        x_rad, y_rad = (after - before for after, before in zip(asked_rad, self._asked_rad, strict=True))
        self._asked_rad, at_s = asked_rad, at_us * 1e-6
        while self._moves and self._moves[0].at_s < at_s - FORGOTTEN_S:
            over = self._moves.pop(0).way_rad
            self._from_rad = self._from_rad[0] + over[0], self._from_rad[1] + over[1]
        self._moves.append(Move(at_s, (x_rad, y_rad)))

    def stick(self, axis: int, at_us: int) -> None:
        """A mirror stays where it is, whatever it is told."""
        self._stuck_rad[axis] = self.angles_rad(at_us)[axis]

    def angles_rad(self, at_us: int) -> tuple[float, float]:
        """Where they stand, rad from their middle."""
        return self._angle_rad(0, at_us * 1e-6), self._angle_rad(1, at_us * 1e-6)

    def _angle_rad(self, axis: int, at_s: float) -> float:
        if axis in self._stuck_rad:
            return self._stuck_rad[axis]
        moved = sum(_followed_rad(self._servo, move.way_rad[axis], at_s - move.at_s) for move in self._moves)
        return self._from_rad[axis] + moved

    def codes(self, at_us: int) -> tuple[float, float]:
        """The codes at which they would rest where they stand."""
        x_rad, y_rad = self.angles_rad(at_us)
        return CENTRE_CODE + x_rad / self._code_rad, CENTRE_CODE + y_rad / self._code_rad

    def output_rad(self, at_us: int) -> tuple[float, float]:
        """What the position outputs say, with their noise."""
        sign = -1.0 if self.inverted else 1.0
        x_rad, y_rad = sign * np.array(self.angles_rad(at_us)) + OUTPUT_NOISE_RAD * self._random.standard_normal(2)
        return float(x_rad), float(y_rad)


def _followed_rad(servo: Servo, way_rad: float, later_s: float) -> float:
    """How far a mirror has come of a move that was commanded later_s ago: the answer to a ramp at the slew limit."""
    since_s = later_s - servo.delay
    ramp_s = abs(way_rad) / servo.slew
    followed = _ramp_s(servo, since_s) - _ramp_s(servo, since_s - ramp_s)
    return followed * (servo.slew if way_rad > 0.0 else -servo.slew)


def _ramp_s(servo: Servo, since_s: float) -> float:
    """A second-order servo's answer to a ramp of slope one, s."""
    if since_s <= 0.0:
        return 0.0
    omega = 2.0 * np.pi * servo.frequency
    damping, turn = servo.damping, omega * sqrt(1.0 - servo.damping**2)
    wave = 2.0 * damping / omega * cos(turn * since_s) + (2.0 * damping**2 - 1.0) / turn * sin(turn * since_s)
    return float(since_s - 2.0 * damping / omega + exp(-damping * omega * since_s) * wave)
