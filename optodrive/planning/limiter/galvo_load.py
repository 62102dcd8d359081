"""What moves warm the mirrors' coils with: a bound on their servos' mean-square acceleration. Kernels.

A servo's target runs at the slew limit for T = d / slew, so its angle accelerates by slew × (h(t) − h(t − T)), h its
answer to an impulse. Moves overlap; the norm of a sum is at most the sum of norms. See docs/decisions/0013.
"""

from math import cos, exp, log, pi, sin, sqrt
from typing import NamedTuple

from optodrive.core.kernels import kernel
from optodrive.planning.limiter.budget import Mirrors


class Motion(NamedTuple):
    """x and y after a move. x2, y2: mean-square acceleration at most, rad²/s⁴; it wanes from `late_s` after at_s on.

    x_swing, y_swing: root of the integral of a² that is still to come after at_s at most, rad/s^1.5
    at_s: when the servo's target arrived at the latest, not counting its delay
    """

    x2: float
    y2: float
    x_swing: float
    y_swing: float
    at_s: float


@kernel
def move_energy(mirrors: Mirrors, move_rad: float) -> float:
    """Integral of a² of a move by itself, rad²/s³: 2 slew² |h|² (1 − ρ(T)); at its most where ρ first turns."""
    omega, damping = mirrors.omega_per_s, mirrors.damping
    root = sqrt(1.0 - damping**2)
    turned = min(omega * root * move_rad / mirrors.slew_rad_per_s, pi)
    alike = exp(-turned * damping / root) * (cos(turned) + damping / root * sin(turned))
    return mirrors.slew_rad_per_s**2 * omega / (2.0 * damping) * (1.0 - alike)


@kernel
def left_of_swing(mirrors: Mirrors, later_s: float) -> float:
    """What is left, later_s after, of the root of the integral of a² of a free swing; the worst of all phases."""
    damping = mirrors.damping
    spread = sqrt((1.0 + damping) / (1.0 - damping))
    return min(1.0, spread * exp(-damping * mirrors.omega_per_s * later_s))


@kernel
def late_s(mirrors: Mirrors) -> float:
    """How long after at_s a move may be counted as if all its a² came at once: what comes later weighs more."""
    rate_per_s = 2.0 * mirrors.damping * mirrors.omega_per_s
    spread = log((1.0 + mirrors.damping) / (1.0 - mirrors.damping))
    return mirrors.delay_s + spread / rate_per_s + 1.0 / (rate_per_s - 1.0 / mirrors.mean_s)


@kernel
def moved(mirrors: Mirrors, motion: Motion, dx_rad: float, dy_rad: float, from_s: float, start_s: float) -> Motion:
    """After a move to a pulse at start_s, the last one having ended at from_s."""
    dx_rad, dy_rad = abs(dx_rad) + mirrors.code_rad, abs(dy_rad) + mirrors.code_rad
    # Mirrors are sent on when a pulse ends; those of a plan's first pulse no later than the plan's lead before it.
    at_s = max(from_s, start_s - mirrors.lead_s) + max(dx_rad, dy_rad) / mirrors.slew_rad_per_s
    left = left_of_swing(mirrors, from_s - mirrors.early_s - motion.at_s)
    x_swing = sqrt(move_energy(mirrors, dx_rad)) + left * motion.x_swing
    y_swing = sqrt(move_energy(mirrors, dy_rad)) + left * motion.y_swing
    # Either place may be a code off.
    waned = exp(-(at_s - motion.at_s - 2.0 * mirrors.code_rad / mirrors.slew_rad_per_s) / mirrors.mean_s)
    return Motion(
        motion.x2 * waned + x_swing**2 / mirrors.mean_s,
        motion.y2 * waned + y_swing**2 / mirrors.mean_s,
        x_swing,
        y_swing,
        at_s,
    )


@kernel
def acceleration2_after(mirrors: Mirrors, motion: Motion, end_s: float) -> float:
    """Mean-square acceleration of either mirror, rad²/s⁴, at most from end_s on, whatever the next move is.

    The next move begins when the pulse ends, though the next pulse may be far off: the greatest one is always counted.
    """
    # Times as planned telescope from move to move: that they may come nearer counts once, here.
    since_s = end_s - mirrors.early_s - motion.at_s
    waned = exp(-(since_s - late_s(mirrors)) / mirrors.mean_s)
    left = left_of_swing(mirrors, since_s)
    greatest = sqrt(move_energy(mirrors, 1e9))
    x2 = motion.x2 * waned + (greatest + left * motion.x_swing) ** 2 / mirrors.mean_s
    y2 = motion.y2 * waned + (greatest + left * motion.y_swing) ** 2 / mirrors.mean_s
    return float(max(x2, y2))
