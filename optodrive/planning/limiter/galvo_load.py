"""Galvo load: an upper bound on the mean-square acceleration of the mirrors, which heats their coils, and its check.

The target of a servo moves at the slew limit for T = d / slew, so that the mirror's acceleration is
slew × (h(t) − h(t − T)), with the servo's impulse response h. Responses to successive moves overlap; the norm of their
sum is at most the sum of their norms. See docs/decisions/0013. Moves from pulse to pulse are checked against the galvo
cap. Kernels.
"""

from math import cos, exp, log, pi, sin, sqrt
from typing import NamedTuple

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.planning.limiter.budget import TOLERANCE, Budget, GalvoModel, select_galvo
from optodrive.planning.limiter.slow_nodes import PulseRequest
from optodrive.planning.limiter.workspace import PixelBudgets


class GalvoState(NamedTuple):
    """Upper bounds on the load of both mirrors after a move.

    x_mean_square, y_mean_square: mean-square acceleration, rad²/s⁴; it decays from `effective_delay_s` after at_s on
    x_ringing, y_ringing: root of the integral of a² over all time after at_s, rad/s^1.5
    at_s: latest arrival time of the servo's target, without the servo's delay
    """

    x_mean_square: float
    y_mean_square: float
    x_ringing: float
    y_ringing: float
    at_s: float


@kernel
def move_energy(galvo: GalvoModel, move_rad: float) -> float:
    """Return an upper bound on the integral of a² over a single move, rad²/s³.

    The integral is 2 slew² |h|² (1 − ρ(T)), with the autocorrelation ρ of h. Moves longer than the first minimum of ρ
    are counted as that minimum.
    """
    omega, damping = galvo.omega_rad_per_s, galvo.damping
    root = sqrt(1.0 - damping**2)
    phase_rad = min(omega * root * move_rad / galvo.slew_rad_per_s, pi)
    autocorrelation = exp(-phase_rad * damping / root) * (cos(phase_rad) + damping / root * sin(phase_rad))
    return galvo.slew_rad_per_s**2 * omega / (2.0 * damping) * (1.0 - autocorrelation)


@kernel
def ringing_envelope_factor(galvo: GalvoModel, elapsed_s: float) -> float:
    """Return an upper bound, over all phases, on the fraction of free ringing that remains after `elapsed_s`.

    The fraction is that of the root of the remaining integral of a².
    """
    damping = galvo.damping
    amplitude_ratio = sqrt((1.0 + damping) / (1.0 - damping))
    # The envelope exceeds 1 just after the move; a free oscillation never has more than it began with.
    return min(1.0, amplitude_ratio * exp(-damping * galvo.omega_rad_per_s * elapsed_s))


@kernel
def effective_delay_s(galvo: GalvoModel) -> float:
    """Return the delay after `GalvoState.at_s` at which the whole a² of a move can be counted as one impulse.

    In an exponentially weighted mean later parts weigh more, so the delay covers the tail of the response.
    """
    rate_per_s = 2.0 * galvo.damping * galvo.omega_rad_per_s
    log_ratio = log((1.0 + galvo.damping) / (1.0 - galvo.damping))
    return galvo.delay_s + log_ratio / rate_per_s + 1.0 / (rate_per_s - 1.0 / galvo.averaging_s)


@kernel
def apply_move(
    galvo: GalvoModel, state: GalvoState, dx_rad: float, dy_rad: float, previous_end_s: float, start_s: float
) -> GalvoState:
    """Return the state after a move to a pulse at `start_s`. The previous pulse ends at `previous_end_s`."""
    # Each end of a move may be rounded by half a code, in the direction that makes it longer.
    dx_rad, dy_rad = abs(dx_rad) + galvo.rad_per_code, abs(dy_rad) + galvo.rad_per_code
    # The mirrors leave when a pulse ends; for the first pulse of a plan, at the start of its lead-in at the latest.
    at_s = max(previous_end_s, start_s - galvo.lead_in_s) + max(dx_rad, dy_rad) / galvo.slew_rad_per_s
    envelope = ringing_envelope_factor(galvo, previous_end_s - galvo.early_s - galvo.timing_slack_s - state.at_s)
    # Norms add (Minkowski), not their squares: the phase of the earlier ringing is not kept, so it may be in step.
    x_ringing = sqrt(move_energy(galvo, dx_rad)) + envelope * state.x_ringing
    y_ringing = sqrt(move_energy(galvo, dy_rad)) + envelope * state.y_ringing
    # Either end of the move may be off by one converter step, and it may begin early.
    shorter_s = galvo.early_s + 2.0 * galvo.rad_per_code / galvo.slew_rad_per_s
    decay = exp(-(at_s - state.at_s - shorter_s) / galvo.averaging_s)
    return GalvoState(
        state.x_mean_square * decay + x_ringing**2 / galvo.averaging_s,
        state.y_mean_square * decay + y_ringing**2 / galvo.averaging_s,
        x_ringing,
        y_ringing,
        at_s,
    )


@kernel
def mean_square_bound(galvo: GalvoModel, state: GalvoState, end_s: float) -> float:
    """Return an upper bound on the mean-square acceleration of both mirrors from `end_s` on, rad²/s⁴.

    The bound holds for any next move: that move begins when the pulse ends, even if the next pulse is much later, so
    the largest possible move is always counted.
    """
    # Planned times telescope from move to move, so their slack counts once, here.
    elapsed_s = end_s - galvo.early_s - galvo.timing_slack_s - state.at_s
    decay = exp(-(elapsed_s - effective_delay_s(galvo)) / galvo.averaging_s)
    envelope = ringing_envelope_factor(galvo, elapsed_s)
    # A move of any length: the energy saturates at the first minimum of the autocorrelation.
    max_move_root = sqrt(move_energy(galvo, 1e9))
    x_mean_square = state.x_mean_square * decay + (max_move_root + envelope * state.x_ringing) ** 2 / galvo.averaging_s
    y_mean_square = state.y_mean_square * decay + (max_move_root + envelope * state.y_ringing) ** 2 / galvo.averaging_s
    return float(max(x_mean_square, y_mean_square))


@kernel
def is_move(budgets: PixelBudgets, request: PulseRequest) -> bool:
    """Return whether a pulse needs a move of the mirrors."""
    mirror_rad = budgets.mirror_rad[request.stage]
    return bool(request.x_rad != mirror_rad[0] or request.y_rad != mirror_rad[1])


@kernel
def galvo_after_move(budget: Budget, budgets: PixelBudgets, request: PulseRequest) -> GalvoState:
    """Return the state of a stage's mirrors after the move to a pulse."""
    stage, mirror_rad = request.stage, budgets.mirror_rad[request.stage]
    mean_square, ringing = budgets.galvo_mean_square[stage], budgets.galvo_ringing[stage]
    before = GalvoState(mean_square[0], mean_square[1], ringing[0], ringing[1], budgets.mirror_at_s[stage])
    dx_rad, dy_rad = request.x_rad - mirror_rad[0], request.y_rad - mirror_rad[1]
    galvo = select_galvo(budget.galvos, stage)
    return apply_move(galvo, before, dx_rad, dy_rad, budgets.end_s[stage], request.start_s)


@kernel
def store_move(budgets: PixelBudgets, request: PulseRequest, galvo_state: GalvoState) -> None:
    """Store the state of a stage's mirrors after the move to a pulse."""
    stage = request.stage
    budgets.galvo_mean_square[stage, 0] = galvo_state.x_mean_square
    budgets.galvo_mean_square[stage, 1] = galvo_state.y_mean_square
    budgets.galvo_ringing[stage, 0], budgets.galvo_ringing[stage, 1] = galvo_state.x_ringing, galvo_state.y_ringing
    budgets.mirror_rad[stage, 0], budgets.mirror_rad[stage, 1] = request.x_rad, request.y_rad
    budgets.mirror_at_s[stage] = galvo_state.at_s


@kernel
def count_galvo_feasible(
    budget: Budget,
    budgets: PixelBudgets,
    stage: IntArray,
    start_s: FloatArray,
    width_s: FloatArray,
    x_rad: FloatArray,
    y_rad: FloatArray,
) -> int:
    """Count the pulses before the first whose move exceeds the galvo cap. Modify the mirrors in `budgets`."""
    for row in range(len(start_s)):
        request = PulseRequest(0, stage[row], start_s[row], width_s[row], x_rad[row], y_rad[row], 0.0, 0.0)
        if is_move(budgets, request):
            galvo_state = galvo_after_move(budget, budgets, request)
            galvo = select_galvo(budget.galvos, request.stage)
            mean_square = mean_square_bound(galvo, galvo_state, request.start_s + request.width_s)
            if mean_square > budget.caps.galvo_rad2_per_s4 * (1 + TOLERANCE):
                return row
            store_move(budgets, request, galvo_state)
        # Also without a move: the next move begins when this pulse ends.
        budgets.end_s[request.stage] = request.start_s + request.width_s
    return len(start_s)
