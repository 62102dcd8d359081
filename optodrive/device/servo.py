"""Simulation of a mirror that follows its command as a second-order servo with a delay and a slew limit."""

from dataclasses import dataclass, replace
from math import pi

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray

STEPS_PER_TIME_CONSTANT = 12
"""Integration steps per time constant 1/ω."""


@dataclass(frozen=True)
class Servo:
    """Parameters of a servo.

    frequency: undamped natural frequency, Hz; damping: damping ratio; delay: s; slew: largest rate of the internal
    target, rad/s
    """

    frequency: float
    damping: float
    delay: float
    slew: float


@dataclass(frozen=True)
class ServoRange:
    """A servo and the half-widths of its uncertainty.

    frequency, damping, slew: relative; delay_s: s
    """

    servo: Servo
    frequency: float
    damping: float
    slew: float
    delay_s: float

    def servo_at(self, frequency: float, damping: float, slew: float, delay: float) -> Servo:
        """Return the servo at a place within the uncertainty, from −1 to 1 in each half-width."""
        servo = self.servo
        return replace(
            servo,
            frequency=servo.frequency * (1.0 + frequency * self.frequency),
            damping=servo.damping * (1.0 + damping * self.damping),
            slew=servo.slew * (1.0 + slew * self.slew),
            delay=servo.delay + delay * self.delay_s,
        )


def simulate_servo(at_s: FloatArray, command_rad: FloatArray, t_s: FloatArray, servo: Servo | None) -> FloatArray:
    """Return the angle at t_s, rad, for commands that each hold from their at_s until the next.

    Before the first command the angle is that of the first one. servo: None for a mirror that follows immediately
    """
    if servo is None:
        # Before the first command a mirror stands where that one sends it: a recording begins at rest.
        row = np.clip(np.searchsorted(at_s, t_s, side="right") - 1, 0, len(at_s) - 1)
        return np.asarray(command_rad[row], dtype=np.float64)
    out = np.zeros(len(t_s))
    omega = 2.0 * pi * servo.frequency
    step_s = 1.0 / (omega * STEPS_PER_TIME_CONSTANT)
    _integrate_servo(
        np.array(at_s) + servo.delay,
        np.array(command_rad),
        np.array(t_s),
        omega,
        servo.damping,
        servo.slew,
        step_s,
        out,
    )
    return out


@kernel
def _integrate_servo(
    at_s: FloatArray,
    command_rad: FloatArray,
    t_s: FloatArray,
    omega: float,
    damping: float,
    slew: float,
    step_s: float,
    out: FloatArray,
) -> None:
    """Write the angle at t_s to `out`, by a midpoint rule with a slew-limited internal target."""
    angle, speed, target = command_rad[0], 0.0, command_rad[0]
    now_s = min(at_s[0], t_s[0]) if len(t_s) else 0.0
    row = 0
    for index in range(len(t_s)):
        while now_s < t_s[index]:
            while row + 1 < len(at_s) and at_s[row + 1] <= now_s:
                row += 1
            requested = command_rad[row] if at_s[row] <= now_s else command_rad[0]
            is_settled = target == requested and abs(speed) < 1e-9 and abs(angle - target) < 1e-12
            end_s = t_s[index]
            if row + 1 < len(at_s) and at_s[row + 1] < end_s:
                end_s = at_s[row + 1]
            if row < len(at_s) and at_s[row] > now_s and at_s[row] < end_s:
                end_s = at_s[row]
            # A settled mirror is jumped over: pauses between moves are most of a recording.
            h_s = end_s - now_s if is_settled else min(step_s, end_s - now_s)
            if not is_settled:
                # The slew limits the target, not the mirror: behind it the two poles ring freely.
                target += min(max(requested - target, -slew * h_s), slew * h_s)
                acceleration = omega * omega * (target - angle) - 2.0 * damping * omega * speed
                middle = angle + 0.5 * h_s * speed
                middle_speed = speed + 0.5 * h_s * acceleration
                acceleration = omega * omega * (target - middle) - 2.0 * damping * omega * middle_speed
                angle += h_s * middle_speed
                speed += h_s * acceleration
            now_s += h_s
        out[index] = angle
