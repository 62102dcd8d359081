"""Moves of the mirrors from pulse to pulse, checked against the galvo cap. Kernels."""

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.planning.limiter.budget import TOLERANCE, Budget
from optodrive.planning.limiter.galvo_load import GalvoState, apply_move, mean_square_bound
from optodrive.planning.limiter.slow_nodes import PulseRequest
from optodrive.planning.limiter.workspace import PixelBudgets


@kernel
def is_move(budgets: PixelBudgets, request: PulseRequest) -> bool:
    """Return whether a pulse needs a move of the mirrors."""
    return bool(request.x_rad != budgets.mirror_rad[0] or request.y_rad != budgets.mirror_rad[1])


@kernel
def galvo_after_move(budget: Budget, budgets: PixelBudgets, request: PulseRequest) -> GalvoState:
    """Return the state of the mirrors after the move to a pulse."""
    x_mean_square, y_mean_square = budgets.galvo_mean_square[0], budgets.galvo_mean_square[1]
    before = GalvoState(
        x_mean_square, y_mean_square, budgets.galvo_ringing[0], budgets.galvo_ringing[1], budgets.mirror_at_s[0]
    )
    dx_rad, dy_rad = request.x_rad - budgets.mirror_rad[0], request.y_rad - budgets.mirror_rad[1]
    return apply_move(budget.galvo, before, dx_rad, dy_rad, budgets.end_s[0], request.start_s)


@kernel
def store_move(budgets: PixelBudgets, request: PulseRequest, galvo_state: GalvoState) -> None:
    """Store the state of the mirrors after the move to a pulse."""
    budgets.galvo_mean_square[0], budgets.galvo_mean_square[1] = galvo_state.x_mean_square, galvo_state.y_mean_square
    budgets.galvo_ringing[0], budgets.galvo_ringing[1] = galvo_state.x_ringing, galvo_state.y_ringing
    budgets.mirror_rad[0], budgets.mirror_rad[1] = request.x_rad, request.y_rad
    budgets.mirror_at_s[0] = galvo_state.at_s


@kernel
def count_galvo_feasible(
    budget: Budget,
    budgets: PixelBudgets,
    start_s: FloatArray,
    width_s: FloatArray,
    x_rad: FloatArray,
    y_rad: FloatArray,
) -> int:
    """Count the pulses before the first whose move exceeds the galvo cap; modifies the mirrors in `budgets`."""
    for row in range(len(start_s)):
        request = PulseRequest(0, start_s[row], width_s[row], x_rad[row], y_rad[row], 0.0)
        if is_move(budgets, request):
            galvo_state = galvo_after_move(budget, budgets, request)
            mean_square = mean_square_bound(budget.galvo, galvo_state, request.start_s + request.width_s)
            if mean_square > budget.caps.galvo_rad2_per_s4 * (1 + TOLERANCE):
                return row
            store_move(budgets, request, galvo_state)
        budgets.end_s[0] = request.start_s + request.width_s
    return len(start_s)
