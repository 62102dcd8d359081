"""One servo that stands for both mirrors: never nearer to rest than either of them, as the gate opens by it."""

from dataclasses import dataclass
from math import cos, exp, pi, sin, sqrt

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import Config
from optodrive.device.gate_timing import settling_s
from optodrive.device.servo import Servo
from optodrive.lab.servo_identification.identify import Identified

DAMPING_MIN, DAMPING_MAX = 0.3, 0.9
"""What a configuration may state."""
FREQUENCY_MIN_HZ = 100.0
ROOM_SHARES = (1.0, 0.75, 0.5)
"""The gate keeps up to so much of its tolerance for former moves."""
MOVES = 8
SLOWER = 0.995
EVEN = 1.001
"""So much sooner is as late."""


@dataclass(frozen=True)
class Common:
    """servo: for both; galvo_share: by how much the galvo cap must be lowered, as the quicker mirror accelerates more.

    later: of x and y, by what share the servo's mean settle time is longer than the mirror's own
    """

    servo: Servo
    galvo_share: float
    later: tuple[float, float]


def common_servo(mirrors: tuple[Identified, Identified], config: Config) -> Common:
    """For moves from a pitch to the whole display, at the gate's tolerances, with each mirror's 95 % interval."""
    moves = [
        (step_rad, share * tolerance_rad, axis)
        for axis, tolerance_rad in enumerate(config.tolerance_rad)
        for step_rad in moves_rad(config, axis)
        for share in ROOM_SHARES
    ]
    needed_s = np.array([mirrors[axis].settled_s(step, tolerance)[2] for step, tolerance, axis in moves])
    candidates = [_late_enough(mirror.servo, mirrors, moves, needed_s) for mirror in mirrors]
    servo = min(candidates, key=lambda each: float(_times_s(each, moves).mean()))
    steps_rad = [step for step, _, _ in moves]
    ratio = max(_energy(each.servo, step) / _energy(servo, step) for each in mirrors for step in steps_rad)
    return Common(servo, min(1.0, 1.0 / sqrt(ratio)), _later(mirrors, servo, moves))


def moves_rad(config: Config, axis: int) -> list[float]:
    """Moves along one axis from a pitch to the whole display, rad."""
    display = config.display
    pitch_rad = display.pitch_m / (2.0 * config.scanner.focal_length_m)
    farthest = max(1, (display.columns, display.rows)[axis] - 1)
    pitches: list[float] = np.unique(np.geomspace(1, farthest, MOVES).round()).tolist()
    return [pitch_rad * way for way in pitches]


def _late_enough(
    start: Servo,
    mirrors: tuple[Identified, Identified],
    moves: list[tuple[float, float, int]],
    needed_s: FloatArray,
) -> Servo:
    """A servo like this one, with the longer delay and the lower slew, as slow as both mirrors need."""
    damping = min(max(start.damping, DAMPING_MIN), DAMPING_MAX)
    delay_s, slew = max(each.servo.delay for each in mirrors), min(each.servo.slew for each in mirrors)
    frequency = start.frequency
    while True:
        servo = Servo(frequency, damping, delay_s, slew)
        if frequency * SLOWER < FREQUENCY_MIN_HZ or np.all(_times_s(servo, moves) * EVEN >= needed_s):
            return servo
        frequency *= SLOWER


def _times_s(servo: Servo, moves: list[tuple[float, float, int]]) -> FloatArray:
    return np.array([settling_s(servo, step, tolerance) for step, tolerance, _ in moves])


def _later(
    mirrors: tuple[Identified, Identified], servo: Servo, moves: list[tuple[float, float, int]]
) -> tuple[float, float]:
    shares = []
    for axis in range(2):
        own = [move for move in moves if move[2] == axis]
        shares.append(float(_times_s(servo, own).mean() / _times_s(mirrors[axis].servo, own).mean()) - 1.0)
    return shares[0], shares[1]


def _energy(servo: Servo, move_rad: float) -> float:
    """Integral of the squared acceleration of a move, rad²/s³, as the limiter counts it."""
    omega, damping = 2.0 * pi * servo.frequency, servo.damping
    root = sqrt(1.0 - damping**2)
    turned = min(omega * root * move_rad / servo.slew, pi)
    alike = exp(-turned * damping / root) * (cos(turned) + damping / root * sin(turned))
    return servo.slew**2 * omega / (2.0 * damping) * (1.0 - alike)
