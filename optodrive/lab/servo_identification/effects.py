"""Servos with one nonlinear effect each, in several forms.

The core is θ'' = ω² (r − θ) − 2 ζ ω θ' + f, with the command r behind a delay. An effect changes r, f or the motion.
All effects are odd. Their amplitudes are in the unit of the command: a torque is stated by the deflection ω⁻² f.
"""

from dataclasses import dataclass
from math import exp, tanh
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import array_kernel
from optodrive.core.types.arrays import FloatArray

SLEW_LIMIT, SATURATION, FRICTION, HYSTERESIS, STIFFNESS = (
    "slew_limit",
    "saturation",
    "dry_friction",
    "hysteresis",
    "amplitude_dependent_stiffness",
)
EFFECTS = (SLEW_LIMIT, SATURATION, FRICTION, HYSTERESIS, STIFFNESS)
BANK = 8
"""Play operators of Rayleigh hysteresis."""

NONE, SLEW, VELOCITY, CLIP, SOFT_CLIP, TORQUE, ACCELERATION, STOP = range(8)
COULOMB, STRIBECK, PRESLIDING, BACKLASH, INPUT_LAG, RAYLEIGH, SPRING_LAG, SPRING, SMOOTH_LAG = range(8, 17)


class Span(NamedTuple):
    """One parameter of an effect: starts of a fit and bounds, as fractions of the scale that is named."""

    scale: str
    starts: tuple[float, ...]
    low: float
    high: float


FIXED = Span("one", (1.0,), 1.0, 1.0)
_THRESHOLD = (0.35, 0.6, 0.85), 0.02, 1.5


@dataclass(frozen=True)
class Form:
    """One form of an effect, with its parameters. A start of the second is of all starts of the first, or of one."""

    name: str
    effect: str
    kind: int
    first: Span
    second: Span = FIXED

    @property
    def starts(self) -> list[tuple[float, float]]:
        """Starts of both parameters together."""
        first, second = self.first.starts, self.second.starts
        return list(zip(first, second if len(second) > 1 else second * len(first), strict=True))


LINEAR_FORM = Form("linear", "linear", NONE, FIXED)
FORMS = (
    Form("slew limit of the command", SLEW_LIMIT, SLEW, Span("slope", *_THRESHOLD)),
    Form("velocity limit of the mirror", SLEW_LIMIT, VELOCITY, Span("speed", *_THRESHOLD)),
    Form("clipped command", SATURATION, CLIP, Span("command", *_THRESHOLD)),
    Form("gradually saturating command", SATURATION, SOFT_CLIP, Span("command", (0.7, 2.0), 0.1, 20.0)),
    Form("saturated control torque", SATURATION, TORQUE, Span("error", *_THRESHOLD)),
    Form("saturated acceleration", SATURATION, ACCELERATION, Span("acceleration", *_THRESHOLD)),
    Form("end stops", SATURATION, STOP, Span("angle", *_THRESHOLD)),
    Form("Coulomb friction", FRICTION, COULOMB, Span("angle", (0.005, 0.03, 0.15), 1e-5, 1.0)),
    Form(
        "Coulomb friction with the Stribeck effect",
        FRICTION,
        STRIBECK,
        Span("angle", (0.02, 0.08), 1e-5, 1.0),
        Span("one", (0.5,), 0.0, 2.0),
    ),
    Form(
        "friction with presliding",
        FRICTION,
        PRESLIDING,
        Span("angle", (0.01, 0.08), 1e-5, 1.0),
        Span("angle", (0.01,), 0.001, 0.04),
    ),
    Form("backlash of the command", HYSTERESIS, BACKLASH, Span("command", (0.01, 0.05, 0.2), 1e-4, 0.9)),
    Form(
        "Bouc–Wen hysteresis of the command",
        HYSTERESIS,
        INPUT_LAG,
        Span("one", (0.1, -0.1), -0.9, 5.0),
        Span("command", (0.2,), 0.03, 2.0),
    ),
    Form(
        "Rayleigh hysteresis of the command",
        HYSTERESIS,
        RAYLEIGH,
        Span("one", (0.1, -0.1), -0.9, 9.0),
        Span("command", (1.0,), 0.1, 2.0),
    ),
    Form(
        "smooth Bouc–Wen hysteresis of the command",
        HYSTERESIS,
        SMOOTH_LAG,
        Span("one", (0.1, -0.1), -0.9, 5.0),
        Span("command", (0.2,), 0.03, 2.0),
    ),
    Form(
        "Bouc–Wen hysteresis of the suspension",
        HYSTERESIS,
        SPRING_LAG,
        Span("one", (0.2, 0.05), 0.0, 5.0),
        Span("angle", (0.2, 0.5), 0.08, 2.0),
    ),
    Form(
        "stiffness that changes with the deflection",
        STIFFNESS,
        SPRING,
        Span("one", (0.1, -0.05), -0.9, 20.0),
        Span("one", (3.0,), 1.5, 6.0),
    ),
)


@array_kernel
def integrate(
    kind: int,
    first: float,
    second: float,
    omega: float,
    zeta: float,
    step: FloatArray,
    drive: FloatArray,
    h_s: float,
    scale: float,
    out: FloatArray,
) -> None:
    """Write the angle after each step of h_s for the command `drive` averaged over each step, from rest.

    step: [2, 3], exact propagation of (θ, θ') and of a force held over a step; scale: deflection to which spring and
    Stribeck speed refer
    """
    angle, speed, target, state = drive[0], 0.0, drive[0], 0.0
    plays = np.full(BANK, drive[0])
    last, w2 = drive[0], omega * omega
    for row in range(len(drive)):
        command = drive[row]
        if kind == SLEW:
            target += min(max(command - target, -first * h_s), first * h_s)
        elif kind == CLIP:
            target = min(max(command, -first), first)
        elif kind == SOFT_CLIP:
            target = first * tanh(command / first)
        elif kind == BACKLASH:
            target = min(max(target, command - first), command + first)
        elif kind == INPUT_LAG:
            change = command - last
            limit = second if change >= 0.0 else -second
            state = limit - (limit - state) * exp(-abs(change) / second)
            target = command + first * state
        elif kind == SMOOTH_LAG:
            change = command - last
            parts = 1 + int(abs(change) / (0.05 * second))
            for _ in range(parts):
                part = change / parts
                state += part - abs(part) * state * abs(state) / second**2
            target = command + first * state
        elif kind == RAYLEIGH:
            total = 0.0
            for at in range(BANK):
                width = second * (at + 0.5) / BANK
                plays[at] = min(max(plays[at], command - width), command + width)
                total += plays[at]
            target = command + first * total / BANK
        else:
            target = command
        last = command
        middle, force = angle + 0.5 * h_s * speed, 0.0
        if kind == TORQUE:
            pull = target - middle
            force = w2 * (min(max(pull, -first), first) - pull)
        elif kind == ACCELERATION:
            pull = target - middle - 2.0 * zeta / omega * speed
            force = w2 * (min(max(pull, -first), first) - pull)
        elif kind == SPRING:
            share = min(abs(middle) / scale, 3.0)
            force = -w2 * first * middle * share ** (second - 1.0)
        elif kind in (SPRING_LAG, PRESLIDING):
            change = h_s * speed
            limit = second if change >= 0.0 else -second
            state = limit - (limit - state) * exp(-abs(change) / second)
            force = -w2 * first * state if kind == SPRING_LAG else -w2 * first * state / second
        load = w2 * target + force
        next_angle = step[0, 0] * angle + step[0, 1] * speed + step[0, 2] * load
        next_speed = step[1, 0] * angle + step[1, 1] * speed + step[1, 2] * load
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
        out[row] = angle
