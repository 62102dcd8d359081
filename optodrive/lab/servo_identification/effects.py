"""Servos with one nonlinear effect each, in several forms.

The core is θ'' = ω² (r − θ) − 2 ζ ω θ' + f, with the command r behind a delay. An effect changes r, f or the motion.
All effects are odd. Their amplitudes are in the unit of the command: a torque is stated by the deflection ω⁻² f.
"""

from dataclasses import dataclass
from math import exp, tanh

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


@dataclass(frozen=True)
class Form:
    """One form of an effect.

    starts: initial (first, second) parameters, each as a fraction of its scale, whose name follows; bounds: of both, as
    fractions likewise. A second parameter with equal bounds is fixed.
    """

    name: str
    effect: str
    kind: int
    scales: tuple[str, str]
    starts: tuple[tuple[float, float], ...]
    low: tuple[float, float]
    high: tuple[float, float]


LINEAR_FORM = Form("linear", "linear", NONE, ("one", "one"), ((1.0, 1.0),), (1.0, 1.0), (1.0, 1.0))
_THRESHOLD = ((0.35, 1.0), (0.6, 1.0), (0.85, 1.0))
_ONE = (0.02, 1.0), (1.5, 1.0)
FORMS = (
    Form("slew limit of the command", SLEW_LIMIT, SLEW, ("slope", "one"), _THRESHOLD, *_ONE),
    Form("velocity limit of the mirror", SLEW_LIMIT, VELOCITY, ("speed", "one"), _THRESHOLD, *_ONE),
    Form("clipped command", SATURATION, CLIP, ("command", "one"), _THRESHOLD, *_ONE),
    Form(
        "gradually saturating command",
        SATURATION,
        SOFT_CLIP,
        ("command", "one"),
        ((0.7, 1.0), (2.0, 1.0)),
        (0.1, 1.0),
        (20.0, 1.0),
    ),
    Form("saturated control torque", SATURATION, TORQUE, ("error", "one"), _THRESHOLD, *_ONE),
    Form("saturated acceleration", SATURATION, ACCELERATION, ("acceleration", "one"), _THRESHOLD, *_ONE),
    Form("end stops", SATURATION, STOP, ("angle", "one"), _THRESHOLD, *_ONE),
    Form(
        "Coulomb friction",
        FRICTION,
        COULOMB,
        ("angle", "one"),
        ((0.005, 1.0), (0.03, 1.0), (0.15, 1.0)),
        (1e-5, 1.0),
        (1.0, 1.0),
    ),
    Form(
        "Coulomb friction with the Stribeck effect",
        FRICTION,
        STRIBECK,
        ("angle", "one"),
        ((0.02, 0.5), (0.08, 0.5)),
        (1e-5, 0.0),
        (1.0, 2.0),
    ),
    Form(
        "friction with presliding",
        FRICTION,
        PRESLIDING,
        ("angle", "angle"),
        ((0.01, 0.01), (0.08, 0.01)),
        (1e-5, 0.001),
        (1.0, 0.04),
    ),
    Form(
        "backlash of the command",
        HYSTERESIS,
        BACKLASH,
        ("command", "one"),
        ((0.01, 1.0), (0.05, 1.0), (0.2, 1.0)),
        (1e-4, 1.0),
        (0.9, 1.0),
    ),
    Form(
        "Bouc–Wen hysteresis of the command",
        HYSTERESIS,
        INPUT_LAG,
        ("one", "command"),
        ((0.1, 0.2), (-0.1, 0.2)),
        (-0.9, 0.03),
        (5.0, 2.0),
    ),
    Form(
        "Rayleigh hysteresis of the command",
        HYSTERESIS,
        RAYLEIGH,
        ("one", "command"),
        ((0.1, 1.0), (-0.1, 1.0)),
        (-0.9, 0.1),
        (9.0, 2.0),
    ),
    Form(
        "smooth Bouc–Wen hysteresis of the command",
        HYSTERESIS,
        SMOOTH_LAG,
        ("one", "command"),
        ((0.1, 0.2), (-0.1, 0.2)),
        (-0.9, 0.03),
        (5.0, 2.0),
    ),
    Form(
        "Bouc–Wen hysteresis of the suspension",
        HYSTERESIS,
        SPRING_LAG,
        ("one", "angle"),
        ((0.2, 0.2), (0.05, 0.5)),
        (0.0, 0.08),
        (5.0, 2.0),
    ),
    Form(
        "stiffness that changes with the deflection",
        STIFFNESS,
        SPRING,
        ("one", "one"),
        ((0.1, 3.0), (-0.05, 3.0)),
        (-0.9, 1.5),
        (20.0, 6.0),
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
