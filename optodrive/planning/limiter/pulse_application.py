"""A plan, pulse by pulse, through the bound: what each cap allows, and what a fired pulse leaves. Kernels."""

from typing import NamedTuple

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.energy_windows import PulseHistory, WindowChains, append, max_window_power_w
from optodrive.planning.limiter.galvo_load import GalvoState, apply_move, mean_square_bound
from optodrive.planning.limiter.heat_bound import (
    ThermalNodes,
    absorber_after_k,
    advance_pixel,
    exchange_wall_heat,
    lower_bound_after_k,
    touch_after_k,
    wall_after_k,
)
from optodrive.planning.limiter.slow_nodes import PulseRequest, slow_node_limits_w, wall_credited_peak_k, wall_peak_k

TOLERANCE = 1e-9
"""Relative excess that floating-point rounding may cause; anything larger is a real excess."""
BISECTIONS = 32


NOTHING, ABSORBER, WIDTH, ENERGY, SPOT, PIXEL_MEAN, DISPLAY_MEAN, WALL, TOUCH, GALVO, ORDER = range(11)
TRIM, STOP, COUNT_ONLY = range(3)
"""What to do with a pulse that a cap does not allow: take power away, stop there, or count it all the same."""


class PixelBudgets(NamedTuple):
    """What each pixel's own pulses leave, and the mirrors; arrays are written to.

    bucket_j, on_s: [p] at the end of the pixel's last pulse; end_s: [1] end of the display's last pulse
    peak_k: [p] largest bound on the absorber so far
    mirror_rad: [2] where the mirrors stand; acceleration2, swing: [2], mirror_at_s: [1], see `mirrors.Motion`
    """

    bucket_j: FloatArray
    merged_width_s: FloatArray
    end_s: FloatArray
    peak_k: FloatArray
    mirror_rad: FloatArray
    galvo_mean_square: FloatArray
    galvo_ringing: FloatArray
    mirror_at_s: FloatArray


class PixelStartState(NamedTuple):
    """A pixel as a pulse begins: absorber over wall, and that at least, K; bucket, J; light without a rest, s."""

    rise_k: float
    lower_bound_k: float
    bucket_j: float
    merged_width_s: float


class LimiterWorkspace(NamedTuple):
    """Everything that changes while a plan is walked through."""

    nodes: ThermalNodes
    budgets: PixelBudgets
    history: PulseHistory
    pixel_chains: WindowChains
    display_chain: WindowChains


@kernel
def replay_history(workspace: LimiterWorkspace) -> None:
    """Chain the pulses that were fired before the plan."""
    for row in range(workspace.history.n_valid[0]):
        append(workspace.pixel_chains, workspace.history.pixel[row], workspace.history, row)
        append(workspace.display_chain, 0, workspace.history, row)


@kernel
def apply_pulses(
    budget: Budget,
    workspace: LimiterWorkspace,
    pixel: IntArray,
    start_s: FloatArray,
    width_s: FloatArray,
    x_rad: FloatArray,
    y_rad: FloatArray,
    power_w: FloatArray,
    policy: int,
    granted_w: FloatArray,
    cause: IntArray,
) -> int:
    """Walk n pulses in order of time; the ledger, given_w and cause [n] are written. Returns how many were walked.

    Fewer than n under STOP: then given_w and cause of the next row say what would have been allowed, and by which cap.
    """
    for row in range(len(pixel)):
        request = PulseRequest(pixel[row], start_s[row], width_s[row], x_rad[row], y_rad[row], power_w[row])
        granted_w[row], cause[row] = request.power_w, NOTHING
        before = _compute_start_state(budget, workspace, request)
        if request.power_w < budget.caps.min_power_w or request.power_w <= 0.0:
            continue
        if policy != COUNT_ONLY:
            max_w, binding = _max_power_w(budget, workspace, request, before)
            if request.power_w > max_w * (1 + TOLERANCE):
                granted_w[row], cause[row] = max(0.0, max_w), binding
                if policy == STOP or max_w < 0.0:
                    return row
                if granted_w[row] < budget.caps.min_power_w:
                    granted_w[row] = 0.0
        if granted_w[row] > 0.0:
            _commit(budget, workspace, request, granted_w[row], before)
    return len(pixel)


@kernel
def _compute_start_state(budget: Budget, workspace: LimiterWorkspace, request: PulseRequest) -> PixelStartState:
    """The pixel as a pulse begins."""
    exchange_wall_heat(budget.heat, workspace.nodes, request.start_s, budget.caps.pulse_width_s)
    advance_pixel(budget.heat, workspace.nodes, request.pixel, request.start_s)
    budgets, pixel = workspace.budgets, request.pixel
    off_s = max(0.0, request.start_s - workspace.nodes.last_pulse_end_s[pixel])
    rise_k = absorber_after_k(budget.heat, pixel, workspace.nodes.absorber_k[pixel], 0.0, off_s)
    lower_bound_k = lower_bound_after_k(budget.heat, pixel, workspace.nodes.lower_bound_k[pixel], 0.0, off_s)
    bucket_j = max(0.0, budgets.bucket_j[pixel] - off_s * budget.caps.pixel_mean_w)
    has_rested = off_s >= budget.caps.pulse_gap_s - TOLERANCE
    return PixelStartState(rise_k, lower_bound_k, bucket_j, 0.0 if has_rested else budgets.merged_width_s[pixel])


@kernel
def _max_power_w(
    budget: Budget, workspace: LimiterWorkspace, request: PulseRequest, before: PixelStartState
) -> tuple[float, int]:
    """Largest power the caps allow a pulse, W, and the cap that binds; below zero for a pulse no power makes right."""
    caps, width_s = budget.caps, request.width_s
    if request.start_s < workspace.budgets.end_s[0] - TOLERANCE:
        return -1.0, ORDER
    if width_s > caps.pulse_width_s * (1 + TOLERANCE):
        return -1.0, WIDTH
    rise_k, lower_bound_k, bucket_j, merged_width_s = before
    if merged_width_s + width_s > caps.pulse_width_s + TOLERANCE:
        return 0.0, WIDTH
    if _is_move(workspace.budgets, request):
        galvo_state = _galvo_after_move(budget, workspace.budgets, request)
        mean_square = mean_square_bound(budget.galvo, galvo_state, request.start_s + width_s)
        if mean_square > caps.galvo_rad2_per_s4 * (1 + TOLERANCE):
            return 0.0, GALVO
    max_w, binding = caps.pulse_energy_j / width_s, ENERGY
    spot_w = (caps.pulse_energy_j - bucket_j) / width_s
    if spot_w < max_w:
        max_w, binding = spot_w, SPOT
    pixel_w = max_window_power_w(
        workspace.pixel_chains,
        request.pixel,
        workspace.history,
        request.start_s,
        width_s,
        caps.pixel_window_s,
        caps.pixel_mean_w,
    )
    if pixel_w < max_w:
        max_w, binding = pixel_w, PIXEL_MEAN
    display_w = max_window_power_w(
        workspace.display_chain,
        0,
        workspace.history,
        request.start_s,
        width_s,
        caps.display_window_s,
        caps.display_mean_w,
    )
    if display_w < max_w:
        max_w, binding = display_w, DISPLAY_MEAN
    wall_w, touch_w = slow_node_limits_w(budget, workspace.nodes, request, lower_bound_k)
    if wall_w < max_w:
        max_w, binding = wall_w, WALL
    if touch_w < max_w:
        max_w, binding = touch_w, TOUCH
    absorber_w = _max_absorber_power_w(budget, workspace, request, rise_k, min(max_w, request.power_w))
    if absorber_w < min(max_w, request.power_w):
        max_w, binding = absorber_w, ABSORBER
    return max(0.0, max_w), binding


@kernel
def _absorber_peak_k(
    budget: Budget, workspace: LimiterWorkspace, request: PulseRequest, rise_k: float, power_w: float
) -> float:
    """Bound on the absorber during a pulse, above ambient."""
    own_k = max(rise_k, absorber_after_k(budget.heat, request.pixel, rise_k, power_w, request.width_s))
    return own_k + budget.heat.absorber_wall_factor * wall_peak_k(budget, workspace.nodes, request, power_w)


@kernel
def _max_absorber_power_w(
    budget: Budget, workspace: LimiterWorkspace, request: PulseRequest, rise_k: float, requested_w: float
) -> float:
    """wanted_w where the absorber bears it, else the largest power that it bears, W."""
    cap_k = budget.caps.absorber_k
    if requested_w <= 0.0 or _absorber_peak_k(budget, workspace, request, rise_k, requested_w) <= cap_k:
        return requested_w
    low_w, high_w = 0.0, requested_w
    for _ in range(BISECTIONS):
        middle_w = 0.5 * (low_w + high_w)
        if _absorber_peak_k(budget, workspace, request, rise_k, middle_w) <= cap_k:
            low_w = middle_w
        else:
            high_w = middle_w
    return low_w


@kernel
def _is_move(budgets: PixelBudgets, request: PulseRequest) -> bool:
    return bool(request.x_rad != budgets.mirror_rad[0] or request.y_rad != budgets.mirror_rad[1])


@kernel
def _galvo_after_move(budget: Budget, budgets: PixelBudgets, request: PulseRequest) -> GalvoState:
    """The mirrors after the move to a pulse."""
    x_mean_square, y_mean_square = budgets.galvo_mean_square[0], budgets.galvo_mean_square[1]
    before = GalvoState(
        x_mean_square, y_mean_square, budgets.galvo_ringing[0], budgets.galvo_ringing[1], budgets.mirror_at_s[0]
    )
    dx_rad, dy_rad = request.x_rad - budgets.mirror_rad[0], request.y_rad - budgets.mirror_rad[1]
    return apply_move(budget.galvo, before, dx_rad, dy_rad, budgets.end_s[0], request.start_s)


@kernel
def _store_move(budgets: PixelBudgets, request: PulseRequest, galvo_state: GalvoState) -> None:
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
    """How many of a plan's first pulses [n] have moves that the mirrors bear; the mirrors' part of spots is written."""
    for row in range(len(start_s)):
        request = PulseRequest(0, start_s[row], width_s[row], x_rad[row], y_rad[row], 0.0)
        if _is_move(budgets, request):
            galvo_state = _galvo_after_move(budget, budgets, request)
            mean_square = mean_square_bound(budget.galvo, galvo_state, request.start_s + request.width_s)
            if mean_square > budget.caps.galvo_rad2_per_s4 * (1 + TOLERANCE):
                return row
            _store_move(budgets, request, galvo_state)
        budgets.end_s[0] = request.start_s + request.width_s
    return len(start_s)


@kernel
def _commit(
    budget: Budget, workspace: LimiterWorkspace, request: PulseRequest, power_w: float, before: PixelStartState
) -> None:
    """Count a pulse as fired."""
    heat, nodes, budgets, pixel = budget.heat, workspace.nodes, workspace.budgets, request.pixel
    rise_k, lower_bound_k, bucket_j, merged_width_s = before
    end_s = request.start_s + request.width_s
    budgets.peak_k[pixel] = max(budgets.peak_k[pixel], _absorber_peak_k(budget, workspace, request, rise_k, power_w))
    nodes.absorber_k[pixel] = absorber_after_k(heat, pixel, rise_k, power_w, request.width_s)
    drive_k = heat.touch_per_wall_k * wall_credited_peak_k(budget, workspace.nodes, request, lower_bound_k, power_w)
    nodes.lower_bound_k[pixel] = lower_bound_after_k(heat, pixel, lower_bound_k, power_w, request.width_s)
    if _is_move(budgets, request):
        _store_move(budgets, request, _galvo_after_move(budget, budgets, request))
    nodes.last_pulse_end_s[pixel] = budgets.end_s[0] = end_s

    for lag in range(2):
        touch_k = touch_after_k(heat, nodes, pixel, lag, drive_k, request.width_s)
        nodes.touch_k[pixel, lag] = touch_k + heat.touch_k_per_j[lag] * power_w * request.width_s
    for capacity in range(2):
        wall_k = wall_after_k(heat, nodes, pixel, capacity, request.width_s)
        nodes.wall_k[pixel, capacity] = wall_k + heat.wall_k_per_j[capacity] * power_w * request.width_s
    nodes.nodes_at_s[pixel] = end_s

    budgets.bucket_j[pixel] = max(0.0, bucket_j + (power_w - budget.caps.pixel_mean_w) * request.width_s)
    budgets.merged_width_s[pixel] = merged_width_s + request.width_s
    history = workspace.history
    row = history.n_valid[0]
    history.start_s[row], history.width_s[row] = request.start_s, request.width_s
    history.power_w[row], history.pixel[row] = power_w, pixel
    history.n_valid[0] = row + 1
    append(workspace.pixel_chains, pixel, history, row)
    append(workspace.display_chain, 0, history, row)
