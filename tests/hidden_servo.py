"""Ground-truth servos, integrated by a Runge-Kutta method, and recordings of their steps."""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from optodrive.core.types.measurements import Measurement, Run, Signal

SIZES_RAD = (0.005, 0.03, 0.15)
NO_PULSES = np.zeros((0, 4))
SETTLING_S = np.linspace(0.0, 0.03, 60_001)


@dataclass(frozen=True)
class HiddenServo:
    """A servo: bandwidth in Hz, damping ratio, delay in s, slew limit in rad/s."""

    hz: float
    damping: float
    delay_s: float
    slew: float

    @classmethod
    def sample(cls, random):
        hz, slew = (float(np.exp(random.uniform(*np.log(ends)))) for ends in ((300.0, 3000.0), (30.0, 300.0)))
        return cls(hz, random.uniform(0.3, 1.0), random.uniform(0.0, 1e-4), slew)

    def knots(self, at_s, command_rad):
        """Return the breakpoints of the slew-limited target: times and positions."""
        times, places, place = [at_s[0]], [command_rad[0]], command_rad[0]
        for row in range(1, len(at_s)):
            begin_s = at_s[row] + self.delay_s
            end_s = at_s[row + 1] + self.delay_s if row + 1 < len(at_s) else np.inf
            way = command_rad[row] - place
            takes_s = abs(way) / self.slew
            times.append(begin_s)
            places.append(place)
            if begin_s + takes_s < end_s:
                place = command_rad[row]
                times.append(begin_s + takes_s)
                places.append(place)
            else:
                place += np.sign(way) * self.slew * (end_s - begin_s)
        return np.array(times), np.array(places)

    def follow(self, at_s, command_rad, t_s):
        """Return the angles at t_s, integrated between breakpoints."""
        times, places = self.knots(at_s, command_rad)
        stiffness, friction = (2.0 * np.pi * self.hz) ** 2, 4.0 * np.pi * self.damping * self.hz

        def rate(now_s, state, begin_s, place, slope):
            angle, speed = state.tolist()
            return [speed, stiffness * (place + slope * (now_s - begin_s) - angle) - friction * speed]

        out, state = np.full(len(t_s), float(command_rad[0])), [command_rad[0], 0.0]
        edges = zip([*times, max(t_s[-1], times[-1]) + 1e-9], [*places, places[-1]], strict=True)
        for (begin_s, place), (end_s, next_place) in pairwise(edges):
            inside = (t_s >= begin_s) & (t_s < end_s)
            if end_s > begin_s:
                line = (float(begin_s), float(place), float((next_place - place) / (end_s - begin_s)))
                solved = solve_ivp(
                    rate, (begin_s, end_s), state, "DOP853", args=line, rtol=1e-9, atol=1e-13, dense_output=True
                )
                out[inside] = solved.sol(t_s[inside])[0] if inside.any() else 0.0
                state = solved.y[:, -1]
        return out

    @cache  # noqa: B019
    def _off_rad(self, step_rad):
        """Return the distance from the end of a step at SETTLING_S."""
        return np.abs(self.follow(np.array([-1.0, 0.0]), np.array([0.0, step_rad]), SETTLING_S) - step_rad)

    def settled_s(self, step_rad, tolerance_rad):
        """Return the settling time from a dense trace: within the tolerance for good, and after the ramp."""
        last_s = SETTLING_S[np.flatnonzero(self._off_rad(step_rad) > tolerance_rad)[-1]]
        return max(last_s, self.delay_s + step_rad / self.slew)


def commands(random, size_rad, count=16):
    """Return commands of steps there and back, x each time and y every other time: t_s, x_rad, y_rad."""
    at_s = np.concatenate([[0.0], 0.002 + 0.015 * np.arange(count) + random.uniform(0.0, 1e-3, count)])
    number = np.arange(count)
    x_rad, y_rad = np.where(number % 2 == 0, size_rad, 0.0), np.where(number // 2 % 2 == 0, size_rad, 0.0)
    return np.column_stack([at_s, np.append(0.0, x_rad), np.append(0.0, y_rad)])


def recording(servos, random, rate_hz=5e4, noise=0.003, sizes_rad=SIZES_RAD, count=16):
    """Build a recording with one run of `count` steps per step size.

    noise: relative to the step
    servos: of x and y
    """
    runs = []
    for number, size_rad in enumerate(sizes_rad):
        table = commands(random, size_rad, count)
        t_s = np.arange(0.0, table[-1, 0] + 0.015, 1.0 / rate_hz)
        angles = [servo.follow(table[:, 0], table[:, 1 + axis], t_s) for axis, servo in enumerate(servos)]
        signals = {
            f"mirror_{axis}_rad": Signal(0, t_s, angle + noise * size_rad * random.standard_normal(len(t_s)))
            for axis, angle in zip("xy", angles, strict=True)
        }
        runs.append(Run(f"run{number}", 295.0, NO_PULSES, signals, {}, table))
    return Measurement(tuple(runs))
