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
    """A servo as it is.

    hz: natural frequency; damping: ratio; delay_s; slew: limit of the target's speed, rad/s; lag_s: time constant of a
    third pole; friction: deceleration by dry friction, rad/s²
    """

    hz: float
    damping: float
    delay_s: float
    slew: float
    lag_s: float = 0.0
    friction: float = 0.0

    def unpack(self):
        """Return the numbers that the integration takes."""
        return 2.0 * np.pi * self.hz, self.damping, self.delay_s, self.slew, self.lag_s, self.friction


@numba.njit
def _accelerate(target, angle, speed, omega, damping):
    return omega * omega * (target - angle) - 2.0 * damping * omega * speed


@numba.njit
def _find_command(times_s, command_rad, at_s):
    """Return the command at a time, straight between its times and constant outside."""
    knot = np.searchsorted(times_s, at_s, side="right") - 1
    if knot < 0:
        return command_rad[0]
    if knot + 1 == len(times_s):
        return command_rad[knot]
    share = (at_s - times_s[knot]) / (times_s[knot + 1] - times_s[knot])
    return command_rad[knot] + share * (command_rad[knot + 1] - command_rad[knot])


@numba.njit
def _advance(state, command, step_s, omega, damping, slew, lag_s, friction):
    """Advance angle, speed, slewed target and lagged target by a step, and return the acceleration at its begin."""
    angle, speed, before = state[0], state[1], state[3]
    state[2] += min(max(command - state[2], -slew * step_s), slew * step_s)
    state[3] = state[2] if lag_s == 0.0 else state[2] + (before - state[2]) * np.exp(-step_s / lag_s)
    target = state[3]
    middle = 0.5 * (before + target)
    a1, v1 = _accelerate(before, angle, speed, omega, damping), speed
    v2 = speed + 0.5 * step_s * a1
    a2 = _accelerate(middle, angle + 0.5 * step_s * v1, v2, omega, damping)
    v3 = speed + 0.5 * step_s * a2
    a3 = _accelerate(middle, angle + 0.5 * step_s * v2, v3, omega, damping)
    v4 = speed + step_s * a3
    a4 = _accelerate(target, angle + step_s * v3, v4, omega, damping)
    state[0] += step_s * (v1 + 2.0 * v2 + 2.0 * v3 + v4) / 6.0
    speed += step_s * (a1 + 2.0 * a2 + 2.0 * a3 + a4) / 6.0
    state[1] = np.sign(speed) * max(abs(speed) - friction * step_s, 0.0)
    return a1


@numba.njit
def _integrate(
    times_s, command_rad, on_s, off_s, places_rad, longest_s, omega, damping, delay_s, slew, lag_s, friction
):
    """Return the largest distance of the angle from the pulse's place while the gate is on, and the integral of a²."""
    state = np.array([command_rad[0], 0.0, command_rad[0], command_rad[0]])
    now_s, pulse, worst_rad, heat = min(times_s[0], on_s[0]) - longest_s, 0, 0.0, 0.0
    while True:
        if on_s[pulse] <= now_s:
            worst_rad = max(worst_rad, abs(state[0] - places_rad[pulse]))
        if now_s == off_s[pulse]:
            pulse += 1
            if pulse == len(on_s):
                return worst_rad, heat
        # A step ends where the gate opens or closes.
        edge_s = on_s[pulse] if now_s < on_s[pulse] else off_s[pulse]
        next_s = min(now_s + longest_s, edge_s)
        command = _find_command(times_s, command_rad, next_s - delay_s)
        a = _advance(state, command, next_s - now_s, omega, damping, slew, lag_s, friction)
        heat += (next_s - now_s) * a * a
        now_s = next_s


@numba.njit
def _follow(times_s, command_rad, t_s, longest_s, omega, damping, delay_s, slew, lag_s, friction, out):
    """Write the angle at t_s [n], in order, to `out`."""
    state = np.array([command_rad[0], 0.0, command_rad[0], command_rad[0]])
    now_s = min(times_s[0], t_s[0])
    for index in range(len(t_s)):
        while now_s < t_s[index]:
            next_s = min(now_s + longest_s, t_s[index])
            command = _find_command(times_s, command_rad, next_s - delay_s)
            _advance(state, command, next_s - now_s, omega, damping, slew, lag_s, friction)
            now_s = next_s
        out[index] = state[0]


def follow(times_s, command_rad, t_s, servo):
    """Return the angle at t_s [n], in order, rad. times_s, command_rad [m]: command, straight between."""
    out = np.empty(len(t_s))
    _follow(times_s, np.ascontiguousarray(command_rad), t_s, LONGEST_S, *servo.unpack(), out)
    return out


def judge(times_s, command_rad, on_s, off_s, places_rad, servos):
    """Return, per axis, the largest distance from the pulse's place while the gate is on, rad, and ∫a², rad²/s³.

    times_s [m], command_rad [m, 2]: command, straight between; on_s, off_s [n], places_rad [n, 2]: pulses; servos: of
    x and y
    """
    found = [
        _integrate(
            times_s,
            np.ascontiguousarray(command_rad[:, axis]),
            on_s,
            off_s,
            np.ascontiguousarray(places_rad[:, axis]),
            LONGEST_S,
            *servo.unpack(),
        )
        for axis, servo in enumerate(servos)
    ]
    return np.array(found).T
