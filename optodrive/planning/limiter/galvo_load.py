"""What moves warm the mirrors' coils with: a bound on their servos' mean-square acceleration. Kernels.

A servo's target runs at the slew limit for T = d / slew, so its angle accelerates by slew × (h(t) − h(t − T)), h its
answer to an impulse. Moves overlap; the norm of a sum is at most the sum of norms. See docs/decisions/0013.
"""

from math import cos, exp, log, pi, sin, sqrt
from typing import NamedTuple

from optodrive.core.kernels import kernel
from optodrive.planning.limiter.budget import GalvoModel


class GalvoState(NamedTuple):
    """x and y after a move. x2, y2: mean-square acceleration at most, rad²/s⁴; it wanes from `late_s` after at_s on.

    x_swing, y_swing: root of the integral of a² that is still to come after at_s at most, rad/s^1.5
    at_s: when the servo's target arrived at the latest, not counting its delay
    """

    x_mean_square: float
    y_mean_square: float
    x_ringing: float
    y_ringing: float
    at_s: float


@kernel
def move_energy(galvo: GalvoModel, move_rad: float) -> float:
    """Integral of a² of a move by itself, rad²/s³: 2 slew² |h|² (1 − ρ(T)); at its most where ρ first turns."""
    omega, damping = galvo.omega_rad_per_s, galvo.damping
    root = sqrt(1.0 - damping**2)
    phase_rad = min(omega * root * move_rad / galvo.slew_rad_per_s, pi)
    autocorrelation = exp(-phase_rad * damping / root) * (cos(phase_rad) + damping / root * sin(phase_rad))
    return galvo.slew_rad_per_s**2 * omega / (2.0 * damping) * (1.0 - autocorrelation)


@kernel
def ringing_envelope_factor(galvo: GalvoModel, elapsed_s: float) -> float:
    """What is left, later_s after, of the root of the integral of a² of a free swing; the worst of all phases."""
    damping = galvo.damping
    amplitude_ratio = sqrt((1.0 + damping) / (1.0 - damping))
    return min(1.0, amplitude_ratio * exp(-damping * galvo.omega_rad_per_s * elapsed_s))


@kernel
def effective_delay_s(galvo: GalvoModel) -> float:
    """How long after at_s a move may be counted as if all its a² came at once: what comes later weighs more."""
    rate_per_s = 2.0 * galvo.damping * galvo.omega_rad_per_s
    log_ratio = log((1.0 + galvo.damping) / (1.0 - galvo.damping))
    return galvo.delay_s + log_ratio / rate_per_s + 1.0 / (rate_per_s - 1.0 / galvo.averaging_s)


@kernel
def apply_move(
    galvo: GalvoModel, state: GalvoState, dx_rad: float, dy_rad: float, previous_end_s: float, start_s: float
) -> GalvoState:
    """After a move to a pulse at start_s, the last one having ended at from_s."""
    dx_rad, dy_rad = abs(dx_rad) + galvo.code_step_rad, abs(dy_rad) + galvo.code_step_rad
    # Mirrors are sent on when a pulse ends; those of a plan's first pulse no later than the plan's lead before it.
    at_s = max(previous_end_s, start_s - galvo.lead_in_s) + max(dx_rad, dy_rad) / galvo.slew_rad_per_s
    envelope = ringing_envelope_factor(galvo, previous_end_s - galvo.interval_shrink_s - state.at_s)
    x_ringing = sqrt(move_energy(galvo, dx_rad)) + envelope * state.x_ringing
    y_ringing = sqrt(move_energy(galvo, dy_rad)) + envelope * state.y_ringing
    # Either place may be a code off.
    decay = exp(-(at_s - state.at_s - 2.0 * galvo.code_step_rad / galvo.slew_rad_per_s) / galvo.averaging_s)
    return GalvoState(
        state.x_mean_square * decay + x_ringing**2 / galvo.averaging_s,
        state.y_mean_square * decay + y_ringing**2 / galvo.averaging_s,
        x_ringing,
        y_ringing,
        at_s,
    )


@kernel
def mean_square_bound(galvo: GalvoModel, state: GalvoState, end_s: float) -> float:
    """Mean-square acceleration of either mirror, rad²/s⁴, at most from end_s on, whatever the next move is.

    The next move begins when the pulse ends, though the next pulse may be far off: the greatest one is always counted.
    """
    # Times as planned telescope from move to move: that they may come nearer counts once, here.
    elapsed_s = end_s - galvo.interval_shrink_s - state.at_s
    decay = exp(-(elapsed_s - effective_delay_s(galvo)) / galvo.averaging_s)
    envelope = ringing_envelope_factor(galvo, elapsed_s)
    max_move_root = sqrt(move_energy(galvo, 1e9))
    x_mean_square = state.x_mean_square * decay + (max_move_root + envelope * state.x_ringing) ** 2 / galvo.averaging_s
    y_mean_square = state.y_mean_square * decay + (max_move_root + envelope * state.y_ringing) ** 2 / galvo.averaging_s
    return float(max(x_mean_square, y_mean_square))
