"""Servos with one nonlinear effect each, in several forms.

The core is θ'' = ω² (r − θ) − 2 ζ ω θ' + f, with the command r behind a delay. An effect changes r, f or the motion.
All effects are odd. Their amplitudes are in the unit of the command: a torque is stated by the deflection ω⁻² f.

Accuracy. Noise may be 10⁻⁴ of a step, so no error of the integration may depend on where in its grid a step begins:
another form would explain it. Effects on the command are therefore computed from the command itself, which is constant
or a ramp between breakpoints, and a cell of the grid takes over its mean and its first moment. Forces are held over a
cell.
"""

from dataclasses import dataclass
from math import exp, tanh
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import array_kernel
from optodrive.core.types.arrays import FloatArray

SLEW_LIMIT, SATURATION, FRICTION, HYSTERESIS = "slew_limit", "saturation", "dry_friction", "hysteresis"
STIFFNESS = "amplitude_dependent_stiffness"
EFFECTS = (SLEW_LIMIT, SATURATION, FRICTION, HYSTERESIS, STIFFNESS)
LABELS = {
    SLEW_LIMIT: "a slew limit",
    SATURATION: "saturation",
    FRICTION: "dry friction",
    HYSTERESIS: "hysteresis",
    STIFFNESS: "a stiffness that depends on the amplitude",
}
BANK = 8
"""Play operators of Rayleigh hysteresis."""
SERIES = 40
"""Terms of a motion's power series over a cell, which is at most a few time constants long."""

NONE, SLEW, CLIP, SOFT_CLIP, BACKLASH, INPUT_LAG, RAYLEIGH, SMOOTH_LAG = range(8)
VELOCITY, TORQUE, ACCELERATION, STOP, COULOMB, STRIBECK, PRESLIDING, SPRING_LAG, SPRING = range(8, 17)
FIRST_OF_MOTION = VELOCITY
"""Kinds below this change the command alone."""


Pair = tuple[float, float]
"""Both parameters of an effect."""
NO_EFFECT = (1.0, 1.0)


class Span(NamedTuple):
    """One parameter of an effect: starts of a fit and bounds, as fractions of the scale that is named."""

    scale: str
    starts: tuple[float, ...]
    low: float
    high: float


FIXED = Span("one", (1.0,), 1.0, 1.0)
_THRESHOLD = (0.35, 0.6, 0.85), 0.02, 1.5
_SLEW = Span("slope", (0.03, 0.08, 0.2, 0.5), 0.005, 1.5)
_PEAK_FRICTION, _STRIBECK = Span("angle", (0.02, 0.08), 1e-5, 1.0), Span("one", (0.5,), 0.0, 2.0)
_FRICTION, _PRESLIDING = Span("angle", (0.01, 0.08), 1e-5, 1.0), Span("angle", (0.01,), 0.001, 0.04)
_LAG, _LAG_WIDTH = Span("one", (0.1, -0.1), -0.9, 5.0), Span("command", (0.2,), 0.03, 2.0)
_RAYLEIGH, _RAYLEIGH_WIDTH = Span("one", (0.1, -0.1), -0.9, 9.0), Span("command", (1.0,), 0.1, 2.0)
_SPRING_LAG, _SPRING_WIDTH = Span("one", (0.2, 0.05), 0.0, 5.0), Span("angle", (0.2, 0.5), 0.08, 2.0)
_SPRING, _SPRING_POWER = Span("one", (0.1, -0.05), -0.9, 20.0), Span("one", (3.0,), 1.5, 6.0)


@dataclass(frozen=True)
class ServoNonlinearity:
    """One form of an effect, with its parameters. A start of the second is of all starts of the first, or of one."""

    name: str
    effect: str
    kind: int
    first: Span
    second: Span = FIXED

    @property
    def changes_command(self) -> bool:
        """Whether the effect changes the command alone, not the motion."""
        return self.kind < FIRST_OF_MOTION

    @property
    def substeps(self) -> int:
        """Parts of a cell: a force that jumps with the command would else depend on where in a cell it does."""
        return 6 if self.kind in (TORQUE, ACCELERATION) else 1

    @property
    def starts(self) -> list[Pair]:
        """Starts of both parameters together."""
        first, second = self.first.starts, self.second.starts
        return list(zip(first, second if len(second) > 1 else second * len(first), strict=True))


LINEAR_FORM = ServoNonlinearity("linear", "linear", NONE, FIXED)
FORMS = (
    ServoNonlinearity("slew limit of the command", SLEW_LIMIT, SLEW, _SLEW),
    ServoNonlinearity("velocity limit of the mirror", SLEW_LIMIT, VELOCITY, Span("speed", *_THRESHOLD)),
    ServoNonlinearity("clipped command", SATURATION, CLIP, Span("command", *_THRESHOLD)),
    ServoNonlinearity("gradually saturating command", SATURATION, SOFT_CLIP, Span("command", (0.7, 2.0), 0.1, 20.0)),
    ServoNonlinearity("saturated control torque", SATURATION, TORQUE, Span("error", *_THRESHOLD)),
    ServoNonlinearity("saturated acceleration", SATURATION, ACCELERATION, Span("acceleration", *_THRESHOLD)),
    ServoNonlinearity("end stops", SATURATION, STOP, Span("angle", *_THRESHOLD)),
    ServoNonlinearity("Coulomb friction", FRICTION, COULOMB, Span("angle", (0.005, 0.03, 0.15), 1e-5, 1.0)),
    ServoNonlinearity("Coulomb friction with the Stribeck effect", FRICTION, STRIBECK, _PEAK_FRICTION, _STRIBECK),
    ServoNonlinearity("friction with presliding", FRICTION, PRESLIDING, _FRICTION, _PRESLIDING),
    ServoNonlinearity("backlash of the command", HYSTERESIS, BACKLASH, Span("command", (0.01, 0.05, 0.2), 1e-4, 0.9)),
    ServoNonlinearity("Bouc–Wen hysteresis of the command", HYSTERESIS, INPUT_LAG, _LAG, _LAG_WIDTH),
    ServoNonlinearity("Rayleigh hysteresis of the command", HYSTERESIS, RAYLEIGH, _RAYLEIGH, _RAYLEIGH_WIDTH),
    ServoNonlinearity("smooth Bouc–Wen hysteresis of the command", HYSTERESIS, SMOOTH_LAG, _LAG, _LAG_WIDTH),
    ServoNonlinearity("Bouc–Wen hysteresis of the suspension", HYSTERESIS, SPRING_LAG, _SPRING_LAG, _SPRING_WIDTH),
    ServoNonlinearity("stiffness that changes with the deflection", STIFFNESS, SPRING, _SPRING, _SPRING_POWER),
)


class Breakpoints(NamedTuple):
    """Value at each breakpoint of a command, and slope from it on, all [n]."""

    begin_s: FloatArray
    value: FloatArray
    slope: FloatArray


@array_kernel
def transform_command(
    kind: int, first: float, second: float, at_s: FloatArray, command: FloatArray, out: Breakpoints
) -> int:
    """Write the breakpoints of the command after an effect on it, and return their number.

    at_s, command: [k] values that hold; out: [2 k]
    """
    begin_s, value, slope = out.begin_s, out.value, out.slope
    target, last, state, count = command[0], command[0], 0.0, 0
    plays = np.full(BANK, command[0])
    for row in range(len(command)):
        now, change = command[row], command[row] - last
        last = now
        if kind == SLEW:
            rate = 0.0 if now == target else (first if now > target else -first)
            begin_s[count], value[count], slope[count] = at_s[row], target, rate
            count += 1
            end_s = at_s[row + 1] if row + 1 < len(command) else np.inf
            reached_s = at_s[row] + abs(now - target) / first
            if reached_s < end_s:
                target = now
                if rate != 0.0:
                    begin_s[count], value[count], slope[count] = reached_s, now, 0.0
                    count += 1
            else:
                target += rate * (end_s - at_s[row])
            continue
        if kind == CLIP:
            target = min(max(now, -first), first)
        elif kind == SOFT_CLIP:
            target = first * tanh(now / first)
        elif kind == BACKLASH:
            target = min(max(target, now - first), now + first)
        elif kind == INPUT_LAG:
            limit = second if change >= 0.0 else -second
            state = limit - (limit - state) * exp(-abs(change) / second)
            target = now + first * state
        elif kind == SMOOTH_LAG:
            parts = 1 + int(abs(change) / (0.05 * second))
            for _ in range(parts):
                part = change / parts
                state += part - abs(part) * state * abs(state) / second**2
            target = now + first * state
        elif kind == RAYLEIGH:
            total = 0.0
            for at in range(BANK):
                width = second * (at + 0.5) / BANK
                plays[at] = min(max(plays[at], now - width), now + width)
                total += plays[at]
            target = now + first * total / BANK
        else:
            target = now
        begin_s[count], value[count], slope[count] = at_s[row], target, 0.0
        count += 1
    return count


@array_kernel
def average_cells(count: int, command: Breakpoints, start_s: float, h_s: float, out: FloatArray) -> None:
    """Write mean and slope of a command with count breakpoints in each cell of h_s from start_s on: [n, 2].

    The slope is that of the line with the command's first moment in the cell.
    """
    begin_s, value, slope = command.begin_s, command.value, command.slope
    row = 0
    for cell in range(len(out)):
        now_s, end_s = start_s + cell * h_s, start_s + (cell + 1) * h_s
        middle_s, mean, moment = now_s + 0.5 * h_s, 0.0, 0.0
        while now_s < end_s:
            while row + 1 < count and begin_s[row + 1] <= now_s:
                row += 1
            until_s = min(end_s, begin_s[row + 1]) if row + 1 < count else end_s
            part_s, from_s = until_s - now_s, now_s - middle_s
            at = value[row] + slope[row] * max(now_s - begin_s[row], 0.0)
            mean += part_s * (at + 0.5 * slope[row] * part_s)
            moment += at * part_s * (from_s + 0.5 * part_s) + slope[row] * part_s**2 * (from_s / 2.0 + part_s / 3.0)
            now_s = until_s
        out[cell, 0], out[cell, 1] = mean / h_s, 12.0 * moment / h_s**3


def change_command(kind: int, effect: Pair, at_s: FloatArray, command: FloatArray) -> Breakpoints:
    """Return the breakpoints of a command [k] that holds from at_s on, after an effect on it."""
    changed = Breakpoints(*np.empty((3, 2 * len(command))))
    count = transform_command(kind, *effect, at_s, command, changed)
    return Breakpoints(*(column[:count] for column in changed))


def build_drive(
    form: ServoNonlinearity, effect: Pair, at_s: FloatArray, command: FloatArray, cells: tuple[float, float, int]
) -> FloatArray:
    """Return mean and slope of a command [k] that holds from at_s on, after an effect on it, in cells: [n, 2].

    cells: time at which the first begins, duration, and number
    """
    kind, parameters = (form.kind, effect) if form.changes_command else (NONE, NO_EFFECT)
    changed, drive = change_command(kind, parameters, at_s, command), np.empty((cells[2], 2))
    average_cells(len(changed.value), changed, *cells[:2], drive)
    return drive


class Motion(NamedTuple):
    """A servo with an effect on its motion.

    step: [2, 4], exact propagation of (θ, θ'), of a load and of its slope over a cell of h_s; scale: deflection to
    which spring and Stribeck speed refer
    """

    kind: int
    first: float
    second: float
    omega: float
    zeta: float
    h_s: float
    scale: float
    step: FloatArray


class NonlinearServo(NamedTuple):
    """A servo with an effect.

    base: log ω, ζ and delay, s; effect: its parameters; scale: deflection to which spring and Stribeck speed refer
    """

    form: ServoNonlinearity
    base: FloatArray
    effect: Pair = NO_EFFECT
    scale: float = 1.0

    def respond(self, drive: FloatArray, h_s: float) -> FloatArray:
        """Return angle and speed after each cell of h_s for the command's mean and slope in each, from rest: [n, 2]."""
        omega, zeta, states = float(np.exp(self.base[0])), float(self.base[1]), np.empty_like(drive)
        step = propagate(omega, zeta, h_s)
        integrate(Motion(self.form.kind, *self.effect, omega, zeta, h_s, self.scale, step), drive, states)
        return states


@array_kernel
def integrate(motion: Motion, drive: FloatArray, out: FloatArray) -> None:
    """Write angle and speed after each cell for the command's mean and slope in each, from rest: [n, 2]."""
    kind, first, second, scale, step = motion.kind, motion.first, motion.second, motion.scale, motion.step
    omega, zeta, h_s = motion.omega, motion.zeta, motion.h_s
    angle, speed, state, w2 = drive[0, 0], 0.0, 0.0, omega * omega
    for row in range(len(drive)):
        target, tilt = drive[row, 0], drive[row, 1]
        middle, force = angle + 0.5 * h_s * speed, 0.0
        if kind in (TORQUE, ACCELERATION):
            lead = 2.0 * zeta / omega if kind == ACCELERATION else 0.0
            push = w2 * (target - angle) - 2.0 * zeta * omega * speed
            middle_speed = speed + 0.5 * h_s * push
            middle += 0.125 * h_s * h_s * push
            limited = min(max(target - middle - lead * middle_speed, -first), first)
            if limited != target - middle - lead * middle_speed:
                # The loop pulls as at a target that moves along with the mirror.
                target, tilt = middle + lead * middle_speed + limited, middle_speed + lead * w2 * limited
        elif kind == SPRING:
            share = min(abs(middle) / scale, 3.0)
            force = -w2 * first * middle * share ** (second - 1.0)
        elif kind in (SPRING_LAG, PRESLIDING):
            change = h_s * speed
            limit = second if change >= 0.0 else -second
            state = limit - (limit - state) * exp(-abs(change) / second)
            force = -w2 * first * state if kind == SPRING_LAG else -w2 * first * state / second
        load, rise = w2 * (target - 0.5 * h_s * tilt) + force, w2 * tilt
        next_angle = step[0, 0] * angle + step[0, 1] * speed + step[0, 2] * load + step[0, 3] * rise
        next_speed = step[1, 0] * angle + step[1, 1] * speed + step[1, 2] * load + step[1, 3] * rise
        if kind in (COULOMB, STRIBECK):
            grip = first * w2 * h_s
            if kind == STRIBECK:
                grip *= 1.0 + second * exp(-((speed / (0.05 * omega * scale)) ** 2))
            loss = min(max(next_speed, -grip), grip)
            next_speed -= loss
            next_angle -= 0.5 * h_s * loss
        elif kind == VELOCITY:
            limited = min(max(next_speed, -first), first)
            if limited != next_speed:
                next_angle, next_speed = angle + 0.5 * h_s * (speed + limited), limited
        elif kind == STOP and abs(next_angle) > first:
            next_angle, next_speed = min(max(next_angle, -first), first), 0.0
        angle, speed = next_angle, next_speed
        out[row, 0], out[row, 1] = angle, speed


@array_kernel
def sample_angle(states: FloatArray, begin_s: float, h_s: float, t_s: FloatArray, out: FloatArray) -> None:
    """Write the angle at each time by the cubic with angle and speed of the states, [n, 2] at begin_s + h_s row."""
    for at in range(len(t_s)):
        place = min(max((t_s[at] - begin_s) / h_s, 0.0), len(states) - 1.0)
        row = min(int(place), len(states) - 2)
        x = place - row
        left, right = states[row, 0], states[row + 1, 0]
        rate_left, rate_right = h_s * states[row, 1], h_s * states[row + 1, 1]
        bend = right - left
        cubic = rate_left + rate_right - 2.0 * bend
        out[at] = left + x * (rate_left + x * (3.0 * bend - 2.0 * rate_left - rate_right + x * cubic))


def propagate(omega: float, zeta: float, h_s: float) -> FloatArray:
    """Return the exact propagation over h_s that `integrate` takes, [2, 4], by the power series of the motion."""
    step = np.empty((2, 4))
    for column in range(4):
        load, rise = float(column == 2), float(column == 3)
        # Coefficients of (t / h)^n.
        here, after = float(column == 0), h_s * (column == 1)
        angle, speed = here, 0.0
        for n in range(1, SERIES):
            angle, speed = angle + after, speed + n * after
            force = h_s**2 * (load * (n == 1) + h_s * rise * (n == 2))
            pull = force - (omega * h_s) ** 2 * here - 2.0 * zeta * omega * h_s * n * after
            here, after = after, pull / (n * (n + 1))
        step[:, column] = angle, speed / h_s
    return step
