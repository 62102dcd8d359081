"""Independent judge of smooth moves: where two mirrors are while the gate is on, by their differential equation.

Servo, slew limit and delay are integrated by a Runge-Kutta method of fourth order. Nothing of the moves' computation is
used.
"""

from dataclasses import dataclass

import numba
import numpy as np

LONGEST_S = 2e-6


@dataclass(frozen=True)
class TrueServo:
    """A servo as it is: natural frequency, Hz; damping ratio; delay, s; slew limit, rad/s."""

    hz: float
    damping: float
    delay_s: float
    slew: float


@numba.njit
def _accelerate(target, angle, speed, omega, damping):
    return omega * omega * (target - angle) - 2.0 * damping * omega * speed


@numba.njit
def _integrate(times_s, command_rad, on_s, off_s, places_rad, omega, damping, delay_s, slew, longest_s):
    """Return the largest distance of the angle from the pulse's place while the gate is on, and the integral of a²."""
    angle, speed, target = command_rad[0], 0.0, command_rad[0]
    now_s, knot, pulse, worst_rad, heat = min(times_s[0], on_s[0]) - longest_s, 0, 0, 0.0, 0.0
    while True:
        if on_s[pulse] <= now_s:
            worst_rad = max(worst_rad, abs(angle - places_rad[pulse]))
        if now_s == off_s[pulse]:
            pulse += 1
            if pulse == len(on_s):
                return worst_rad, heat
        # A step ends where the gate opens or closes.
        edge_s = on_s[pulse] if now_s < on_s[pulse] else off_s[pulse]
        next_s = min(now_s + longest_s, edge_s)
        step_s = next_s - now_s
        command_s = next_s - delay_s
        while knot + 1 < len(times_s) and times_s[knot + 1] <= command_s:
            knot += 1
        command = command_rad[knot]
        if command_s > times_s[knot] and knot + 1 < len(times_s):
            share = (command_s - times_s[knot]) / (times_s[knot + 1] - times_s[knot])
            command += share * (command_rad[knot + 1] - command)
        before = target
        target += min(max(command - target, -slew * step_s), slew * step_s)
        middle = 0.5 * (before + target)
        a1, v1 = _accelerate(before, angle, speed, omega, damping), speed
        v2 = speed + 0.5 * step_s * a1
        a2 = _accelerate(middle, angle + 0.5 * step_s * v1, v2, omega, damping)
        v3 = speed + 0.5 * step_s * a2
        a3 = _accelerate(middle, angle + 0.5 * step_s * v2, v3, omega, damping)
        v4 = speed + step_s * a3
        a4 = _accelerate(target, angle + step_s * v3, v4, omega, damping)
        angle += step_s * (v1 + 2.0 * v2 + 2.0 * v3 + v4) / 6.0
        speed += step_s * (a1 + 2.0 * a2 + 2.0 * a3 + a4) / 6.0
        heat += step_s * a1 * a1
        now_s = next_s


def judge(times_s, command_rad, on_s, off_s, places_rad, servo):
    """Return, per axis, the largest distance from the pulse's place while the gate is on, rad, and ∫a², rad²/s³.

    times_s [m], command_rad [m, 2]: command, straight between; on_s, off_s [n], places_rad [n, 2]: pulses
    """
    found = [
        _integrate(
            times_s,
            np.ascontiguousarray(command_rad[:, axis]),
            on_s,
            off_s,
            np.ascontiguousarray(places_rad[:, axis]),
            2.0 * np.pi * servo.hz,
            servo.damping,
            servo.delay_s,
            servo.slew,
            LONGEST_S,
        )
        for axis in range(2)
    ]
    return np.array(found).T
