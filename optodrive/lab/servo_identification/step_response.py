"""The angle of a servo that was told steps, in closed form: between two bends of its target it swings freely.

The target is a line from bend to bend; the error to it is what the slope leaves, −2ζ slope / ω, and Re(2 A exp(λ t)).
"""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray, freeze_arrays
from optodrive.device.gate_timing import pole_per_s
from optodrive.device.servo import Servo


@dataclass(frozen=True, eq=False)
class Steps:
    """What one mirror was told: from each at_s, s, on command_rad; the first one from the beginning. All [k]."""

    at_s: FloatArray
    command_rad: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def sizes_rad(self) -> FloatArray:
        """How far each step leads, without its sign, [k − 1]."""
        sizes: FloatArray = np.abs(np.diff(self.command_rad))
        return sizes


def angles_rad(servo: Servo, steps: Steps, t_s: FloatArray) -> FloatArray:
    """Angle at t_s, rad; at rest at the first command before. The servo's damping lies below 1."""
    pole = pole_per_s(servo)
    left_over = -2.0 * servo.damping / (2.0 * np.pi * servo.frequency)
    bends = _bends(servo, steps)
    swings = np.empty(len(bends), dtype=np.complex128)
    angle, speed = bends[0][1], 0.0
    for row, (at_s, target, slope) in enumerate(bends):
        error, rate = angle - target - left_over * slope, speed - slope
        # e = 2 Re(A), e' = 2 Re(λ A)
        swings[row] = swing = 0.5 * complex(error, (pole.real * error - rate) / pole.imag)
        if row + 1 < len(bends):
            later_s = bends[row + 1][0] - at_s
            swung = 2.0 * swing * np.exp(pole * later_s)
            angle = target + slope * (later_s + left_over) + swung.real
            speed = slope + (pole * swung).real
    begin_s, target, slope = np.array(bends).T
    row_of = np.clip(np.searchsorted(begin_s, t_s, side="right") - 1, 0, None)
    since_s = np.maximum(t_s - begin_s[row_of], 0.0)
    swung = 2.0 * (swings[row_of] * np.exp(pole * since_s)).real
    found: FloatArray = target[row_of] + slope[row_of] * (since_s + left_over) + swung
    return found


def _bends(servo: Servo, steps: Steps) -> list[tuple[float, float, float]]:
    """Where the target's line bends: time, target there and its slope from there on."""
    at_s, command = (steps.at_s + servo.delay).tolist(), steps.command_rad.tolist()
    target = command[0]
    bends = [(at_s[0], target, 0.0)]
    for row in range(1, len(at_s)):
        way, end_s = command[row] - target, at_s[row + 1] if row + 1 < len(at_s) else np.inf
        if way == 0.0:
            bends.append((at_s[row], target, 0.0))
            continue
        slope, there_s = (servo.slew if way > 0.0 else -servo.slew), at_s[row] + abs(way) / servo.slew
        bends.append((at_s[row], target, slope))
        if there_s < end_s:
            target = command[row]
            bends.append((there_s, target, 0.0))
        else:
            target += slope * (end_s - at_s[row])
    return bends
