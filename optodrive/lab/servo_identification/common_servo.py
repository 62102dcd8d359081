"""One servo model for both mirrors that settles no sooner than either of them, since the gate timing relies on it."""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, exp, pi, sin, sqrt

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import DAMPING_MAX, Config
from optodrive.device.config_sections import ServoSection
from optodrive.device.gate_timing import settling_s
from optodrive.device.servo import Servo
from optodrive.lab.servo_identification.identify import IdentifiedServo

DAMPING_MIN, COMMON_DAMPING_MAX = 0.3, 0.9
"""Range of the configuration."""
FREQUENCY_MIN_HZ = 100.0
TOLERANCE_SHARES = (1.0, 0.75, 0.5)
"""Shares of the gate's tolerance at which settling is compared; former moves may use the rest."""
MOVE_SIZE_COUNT = 8
FREQUENCY_STEP = 0.995
SIGMAS = 3.0
"""Half-width of an identified parameter, in its standard deviations."""
HALF_WIDTH_MIN, HALF_WIDTH_MAX = 0.02, 0.3
"""Range of relative half-widths."""
UNMEASURED_HALF_WIDTH = float(ServoSection.model_fields["slew_uncertainty"].default)
DELAY_HALF_WIDTH_MIN_S = 1e-5
"""A sample of a servo's digital driver, s."""
SETTLING_SLACK = 1.001
"""Permitted ratio of required to actual settling time."""


@dataclass(frozen=True)
class CommonServo:
    """A servo model for both mirrors.

    galvo_share: factor on the galvo cap, since the faster mirror accelerates more than the model
    settling_excess: of x and y, relative excess of the model's mean settling time over the mirror's own
    """

    servo: Servo
    galvo_share: float
    settling_excess: tuple[float, float]


def find_common_servo(
    mirrors: tuple[IdentifiedServo, IdentifiedServo],
    config: Config,
    settle: Callable[[int, float, float], float] = lambda axis, move_rad, tolerance_rad: 0.0,
) -> CommonServo:
    """Find the servo with the smallest mean settling time that covers the 95 % intervals of both mirrors.

    Moves range from one pitch to the whole display, at the gate's tolerances.

    settle: further lower bound of the settling time of a move of an axis, s
    """
    moves = [
        (step_rad, share * tolerance_rad, axis)
        for axis, tolerance_rad in enumerate(config.tolerance_rad)
        for step_rad in move_sizes_rad(config, axis)
        for share in TOLERANCE_SHARES
    ]
    required_s = np.array(
        [
            max(mirrors[axis].settling_s(step, tolerance)[2], settle(axis, step, tolerance))
            for step, tolerance, axis in moves
        ]
    )
    candidates = [_slow_to_required(mirror.servo, mirrors, moves, required_s) for mirror in mirrors]
    servo = min(candidates, key=lambda each: float(_settling_times_s(each, moves).mean()))
    steps_rad = [step for step, _, _ in moves]
    ratio = max(
        _acceleration_energy(each.servo, step) / _acceleration_energy(servo, step)
        for each in mirrors
        for step in steps_rad
    )
    return CommonServo(servo, min(1.0, 1.0 / sqrt(ratio)), _settling_excess(mirrors, servo, moves))


def find_half_widths(
    mirrors: tuple[IdentifiedServo, IdentifiedServo], servo: Servo
) -> tuple[float, float, float, float]:
    """Return the half-widths of frequency, damping, slew (relative) and delay (s) within which plans take the servo.

    They are three standard deviations, and at least what temperature may change; the delay's at least a sample of the
    servo's driver. A slew that the recording does not show keeps the half-width of one that was never measured.
    """
    frequency, damping, delay_s, inverse_slew = SIGMAS * np.max([each.sigma for each in mirrors], axis=0)
    slew = servo.slew * inverse_slew if all(each.slew_identified for each in mirrors) else UNMEASURED_HALF_WIDTH
    relative = np.clip([frequency, damping / servo.damping, slew], HALF_WIDTH_MIN, HALF_WIDTH_MAX).tolist()
    relative[1] = min(relative[1], DAMPING_MAX / servo.damping - 1.0)
    return *relative, max(float(delay_s), DELAY_HALF_WIDTH_MIN_S)


def move_sizes_rad(config: Config, axis: int) -> list[float]:
    """Return sizes of moves along one axis from one pitch to the whole display, rad."""
    display = config.display
    pitch_rad = display.pitch_m / (2.0 * config.scanner.focal_length_m)
    farthest = max(1, (display.columns, display.rows)[axis] - 1)
    pitches: list[float] = np.unique(np.geomspace(1, farthest, MOVE_SIZE_COUNT).round()).tolist()
    return [pitch_rad * pitch_count for pitch_count in pitches]


def _slow_to_required(
    start: Servo,
    mirrors: tuple[IdentifiedServo, IdentifiedServo],
    moves: list[tuple[float, float, int]],
    required_s: FloatArray,
) -> Servo:
    """Lower the frequency of a servo, with the longer delay and the lower slew, until it settles as required."""
    damping = min(max(start.damping, DAMPING_MIN), COMMON_DAMPING_MAX)
    delay_s, slew = max(each.servo.delay for each in mirrors), min(each.servo.slew for each in mirrors)
    frequency = start.frequency
    while True:
        servo = Servo(frequency, damping, delay_s, slew)
        if frequency * FREQUENCY_STEP < FREQUENCY_MIN_HZ or np.all(
            _settling_times_s(servo, moves) * SETTLING_SLACK >= required_s
        ):
            return servo
        frequency *= FREQUENCY_STEP


def _settling_times_s(servo: Servo, moves: list[tuple[float, float, int]]) -> FloatArray:
    return np.array([settling_s(servo, step, tolerance) for step, tolerance, _ in moves])


def _settling_excess(
    mirrors: tuple[IdentifiedServo, IdentifiedServo], servo: Servo, moves: list[tuple[float, float, int]]
) -> tuple[float, float]:
    shares = []
    for axis in range(2):
        axis_moves = [move for move in moves if move[2] == axis]
        shares.append(
            float(
                _settling_times_s(servo, axis_moves).mean() / _settling_times_s(mirrors[axis].servo, axis_moves).mean()
            )
            - 1.0
        )
    return shares[0], shares[1]


def _acceleration_energy(servo: Servo, move_rad: float) -> float:
    """Return the integral of the squared acceleration of a move, rad²/s³, as the limiter computes it."""
    omega, damping = 2.0 * pi * servo.frequency, servo.damping
    root = sqrt(1.0 - damping**2)
    phase = min(omega * root * move_rad / servo.slew, pi)
    overlap = exp(-phase * damping / root) * (cos(phase) + damping / root * sin(phase))
    return servo.slew**2 * omega / (2.0 * damping) * (1.0 - overlap)
