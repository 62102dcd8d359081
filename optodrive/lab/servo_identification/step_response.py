"""Closed-form response of a second-order servo with delay and slew limit to commanded steps.

The slew-limited target is piecewise linear. Between its breakpoints the error is the ramp lag −2ζ slope / ω plus the
free oscillation Re(2 A exp(λ t)).
"""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray, freeze_arrays
from optodrive.device.gate_timing import pole_per_s
from optodrive.device.servo import Servo


@dataclass(frozen=True, eq=False)
class Steps:
    """Commands of one mirror, all [k]: command_rad from at_s (s) on. The first one holds from the beginning."""

    at_s: FloatArray
    command_rad: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def sizes_rad(self) -> FloatArray:
        """Absolute size of each step, rad, [k − 1]."""
        sizes: FloatArray = np.abs(np.diff(self.command_rad))
        return sizes


def step_response_rad(servo: Servo, steps: Steps, t_s: FloatArray) -> FloatArray:
    """Return the angle at t_s, rad, from steady state at the first command. The damping must be below 1."""
    pole = pole_per_s(servo)
    ramp_lag_s = -2.0 * servo.damping / (2.0 * np.pi * servo.frequency)
    breakpoints = _find_breakpoints(servo, steps)
    modes = np.empty(len(breakpoints), dtype=np.complex128)
    angle, speed = breakpoints[0][1], 0.0
    for row, (at_s, target, slope) in enumerate(breakpoints):
        error, rate = angle - target - ramp_lag_s * slope, speed - slope
        # e = 2 Re(A), e' = 2 Re(λ A)
        modes[row] = mode = 0.5 * complex(error, (pole.real * error - rate) / pole.imag)
        if row + 1 < len(breakpoints):
            later_s = breakpoints[row + 1][0] - at_s
            transient = 2.0 * mode * np.exp(pole * later_s)
            angle = target + slope * (later_s + ramp_lag_s) + transient.real
            speed = slope + (pole * transient).real
    begin_s, target, slope = np.array(breakpoints).T
    row_of = np.clip(np.searchsorted(begin_s, t_s, side="right") - 1, 0, None)
    since_s = np.maximum(t_s - begin_s[row_of], 0.0)
    transient = 2.0 * (modes[row_of] * np.exp(pole * since_s)).real
    response: FloatArray = target[row_of] + slope[row_of] * (since_s + ramp_lag_s) + transient
    return response


def _find_breakpoints(servo: Servo, steps: Steps) -> list[tuple[float, float, float]]:
    """Return the breakpoints of the slew-limited target: time, target, and slope after it."""
    at_s, command = (steps.at_s + servo.delay).tolist(), steps.command_rad.tolist()
    target = command[0]
    breakpoints = [(at_s[0], target, 0.0)]
    for row in range(1, len(at_s)):
        step_rad, end_s = command[row] - target, at_s[row + 1] if row + 1 < len(at_s) else np.inf
        if step_rad == 0.0:
            breakpoints.append((at_s[row], target, 0.0))
            continue
        slope, reached_s = (servo.slew if step_rad > 0.0 else -servo.slew), at_s[row] + abs(step_rad) / servo.slew
        breakpoints.append((at_s[row], target, slope))
        if reached_s < end_s:
            target = command[row]
            breakpoints.append((reached_s, target, 0.0))
        else:
            target += slope * (end_s - at_s[row])
    return breakpoints
