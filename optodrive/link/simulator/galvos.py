"""Simulated galvos: mirror angles over time, and the position outputs of the driver."""

from math import cos, exp, sin, sqrt
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import Config
from optodrive.device.config_sections import HALF_RANGE_CODES
from optodrive.device.gate_timing import build_servo
from optodrive.device.servo import Servo
from optodrive.link.board_setup import build_scales

CENTRE_CODE = HALF_RANGE_CODES + 1
OUTPUT_NOISE_RAD = 1e-5
TRACE_PERIOD_S = 20e-6
"""Time between samples of a recorded output."""
MOVE_HISTORY_S = 0.5
"""A move this old has settled."""


class GalvoMove(NamedTuple):
    """A commanded move: its time, and the displacement of x and y."""

    at_s: float
    displacement_rad: tuple[float, float]


class SimulatedGalvos:
    """Two mirrors that follow codes with the configured servo. Angles are nominal, in rad.

    Overlapping moves are superposed. The slew limit makes this inexact while they overlap; the end positions are exact.
    """

    def __init__(self, config: Config, seed: int | np.random.SeedSequence) -> None:
        self._servo = build_servo(config.scanner)
        (self._scale,) = build_scales(config)
        self._random = np.random.default_rng(seed)
        self._base_rad = (0.0, 0.0)
        self._target_rad = (0.0, 0.0)
        self._moves: list[GalvoMove] = []
        self._stuck_rad: dict[int, float] = {}
        self.readback_inverted = False

    def move_to(self, x_output: int, y_output: int, at_us: int) -> None:
        """Command both mirrors to codes at a time. x_output, y_output: of the converter, wired as configured."""
        x_codes, y_codes = self._scale.to_axes(np.array(x_output), np.array(y_output))
        target_rad = float(self._scale.to_angles_rad(x_codes)), float(self._scale.to_angles_rad(y_codes))
        if target_rad == self._target_rad:
            return
        x_rad, y_rad = (after - before for after, before in zip(target_rad, self._target_rad, strict=True))
        self._target_rad, at_s = target_rad, at_us * 1e-6
        while self._moves and self._moves[0].at_s < at_s - MOVE_HISTORY_S:
            finished_rad = self._moves.pop(0).displacement_rad
            self._base_rad = self._base_rad[0] + finished_rad[0], self._base_rad[1] + finished_rad[1]
        self._moves.append(GalvoMove(at_s, (x_rad, y_rad)))

    def stick(self, axis: int, at_us: int) -> None:
        """Block the mirror of an axis at its present angle."""
        self._stuck_rad[axis] = self.angles_rad(at_us)[axis]

    def angles_rad(self, at_us: int) -> tuple[float, float]:
        """Return the angles of x and y from the centre, rad."""
        return self._angle_rad(0, at_us * 1e-6), self._angle_rad(1, at_us * 1e-6)

    def _angle_rad(self, axis: int, at_s: float) -> float:
        if axis in self._stuck_rad:
            return self._stuck_rad[axis]
        moved = sum(
            _move_response_rad(self._servo, move.displacement_rad[axis], at_s - move.at_s) for move in self._moves
        )
        return self._base_rad[axis] + moved

    def codes(self, at_us: int) -> tuple[float, float]:
        """Return the codes of x and y whose steady-state angles are the present ones."""
        x_rad, y_rad = self.angles_rad(at_us)
        return CENTRE_CODE + x_rad / self._scale.rad_per_code, CENTRE_CODE + y_rad / self._scale.rad_per_code

    def measure(self, at_us: int) -> FloatArray:
        """Return the noisy codes of outputs X and Y that the position outputs show."""
        codes = CENTRE_CODE + np.array(self.position_output_rad(at_us)) / self._scale.rad_per_code
        return np.array(self._scale.to_outputs(codes[0], codes[1]))

    def position_output_rad(self, at_us: int) -> tuple[float, float]:
        """Return the noisy position outputs of x and y, rad."""
        sign = -1.0 if self.readback_inverted else 1.0
        x_rad, y_rad = sign * np.array(self.angles_rad(at_us)) + OUTPUT_NOISE_RAD * self._random.standard_normal(2)
        return float(x_rad), float(y_rad)


def measure_position_outputs(config: Config, commands: FloatArray, until_s: float, seed: int) -> FloatArray:
    """Measure the position outputs of mirrors that were commanded, [n, 3] of t_s, x_rad and y_rad from 0 s on.

    commands: [m, 3] t_s, x_rad, y_rad in order; the mirrors rest at the first ones
    """
    galvos, readings, period_us = SimulatedGalvos(config, seed), [], round(1e6 * TRACE_PERIOD_S)
    (scale,) = build_scales(config)
    codes = np.column_stack(scale.to_outputs(*scale.to_codes(commands[:, 1:]).T)).tolist()
    galvos.move_to(codes[0][0], codes[0][1], round(-1e6 * MOVE_HISTORY_S))
    steps = list(zip(np.rint(1e6 * commands[1:, 0]).astype(int).tolist(), codes[1:], strict=True))
    for at_us in range(0, round(1e6 * until_s), period_us):
        while steps and steps[0][0] <= at_us:
            due_us, (x_output, y_output) = steps.pop(0)
            galvos.move_to(x_output, y_output, due_us)
        readings.append((at_us * 1e-6, *galvos.position_output_rad(at_us)))
    return np.array(readings)


def _move_response_rad(servo: Servo, displacement_rad: float, elapsed_s: float) -> float:
    """Return a move's displacement elapsed_s after its command, rad: the response to a ramp at the slew limit."""
    since_s = elapsed_s - servo.delay
    ramp_s = abs(displacement_rad) / servo.slew
    response_s = _ramp_response_s(servo, since_s) - _ramp_response_s(servo, since_s - ramp_s)
    return response_s * (servo.slew if displacement_rad > 0.0 else -servo.slew)


def _ramp_response_s(servo: Servo, since_s: float) -> float:
    """Return the response of the second-order servo to a ramp of slope one, s."""
    if since_s <= 0.0:
        return 0.0
    omega = 2.0 * np.pi * servo.frequency
    damping, damped_omega = servo.damping, omega * sqrt(1.0 - servo.damping**2)
    ringing = 2.0 * damping / omega * cos(damped_omega * since_s) + (2.0 * damping**2 - 1.0) / damped_omega * sin(
        damped_omega * since_s
    )
    return float(since_s - 2.0 * damping / omega + exp(-damping * omega * since_s) * ringing)
