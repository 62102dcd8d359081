"""Moves of the mirrors from pulse to pulse, checked against the galvo cap. Kernels."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.planning.limiter.budget import TOLERANCE, Budget, select_galvo
from optodrive.planning.limiter.galvo_load import GalvoState, apply_move, mean_square_bound
from optodrive.planning.limiter.slow_nodes import PulseRequest
from optodrive.planning.limiter.workspace import PixelBudgets


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
        budgets.end_s[request.stage] = request.start_s + request.width_s
    return len(start_s)
