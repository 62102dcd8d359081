"""The computations of every cap: the largest power that it allows a pulse, and how much of it is in use at a moment.

Kernels compute them.
"""

from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.plans import BudgetState
from optodrive.planning.limiter.budget import TOLERANCE, Budget, select_galvo
from optodrive.planning.limiter.caps import CAP_NUMBERS, CAPS, WRONG_ORDER
from optodrive.planning.limiter.galvo_load import galvo_after_move, is_move, mean_square_bound
from optodrive.planning.limiter.heat_bound import (
    absorber_after_k,
    advance_pixel,
    exchange_wall_heat,
    panel_peak_k,
    wall_bound_k,
)
from optodrive.planning.limiter.slow_nodes import PulseRequest, slow_node_limits_w, wall_peak_k
from optodrive.planning.limiter.workspace import LimiterWorkspace, max_window_power_w, open_workspace

# They leave 2e-10 of the requested power.
BISECTIONS = 32

ABSORBER_TEMPERATURE = CAP_NUMBERS["absorber_temperature"]
WALL_TEMPERATURE = CAP_NUMBERS["wall_temperature"]
TOUCH_TEMPERATURE = CAP_NUMBERS["touch_temperature"]
PULSE_ENERGY = CAP_NUMBERS["pulse_energy"]
SPOT_ENERGY = CAP_NUMBERS["spot_energy"]
PULSE_WIDTH = CAP_NUMBERS["pulse_width"]
PIXEL_MEAN_POWER = CAP_NUMBERS["pixel_mean_power"]
DISPLAY_MEAN_POWER = CAP_NUMBERS["display_mean_power"]
GALVO_ACCELERATION = CAP_NUMBERS["galvo_acceleration"]
DIM = CAP_NUMBERS["dim"]


class PixelStartState(NamedTuple):
    """State of a pixel at the start of a pulse.

    rise_k, lower_bound_k: upper and lower bound of the absorber's rise over its wall; bucket_j: energy bucket
    merged_width_s: total width of earlier pulses without a gap
    """

    rise_k: float
    lower_bound_k: float
    bucket_j: float
    merged_width_s: float


@kernel
def max_power_w(
    budget: Budget, workspace: LimiterWorkspace, request: PulseRequest, before: PixelStartState
) -> tuple[float, int]:
    """Return the largest power that all caps allow a pulse, W, and the number of the binding cap.

    A negative power marks a pulse that is infeasible at any power and under any policy.
    """
    caps, width_s = budget.caps, request.width_s
    begins_s = max(workspace.budgets.begun_s[0], workspace.budgets.end_s[request.stage])
    # Refusals before trims: these hold under every policy, and no power would mend them.
    if request.start_s < max(begins_s, workspace.nodes.last_pulse_end_s[request.pixel]) - TOLERANCE:
        return -1.0, WRONG_ORDER
    if width_s > caps.pulse_width_s * (1 + TOLERANCE):
        return -1.0, PULSE_WIDTH
    rise_k, lower_bound_k, bucket_j, merged_width_s = before
    if merged_width_s + width_s > caps.pulse_width_s + TOLERANCE:
        # Pulses without a gap count as one, as in the board's guard B4. Without light the rule holds, so the pulse is
        # trimmed and not refused.
        return 0.0, PULSE_WIDTH
    # The mirrors heat by the way, not by the light: a pulse that needs no move costs nothing, and one that needs one is
    # all or nothing.
    if is_move(workspace.budgets, request):
        galvo_state = galvo_after_move(budget, workspace.budgets, request)
        galvo = select_galvo(budget.galvos, request.stage)
        # Until the pulse's end: from there on the bound always leaves room for the largest next move, so mirrors can
        # always leave.
        mean_square = mean_square_bound(galvo, galvo_state, request.start_s + width_s)
        if mean_square > caps.galvo_rad2_per_s4 * (1 + TOLERANCE):
            return 0.0, GALVO_ACCELERATION
    # Cheap caps first: the last ones bisect, from what is left of the power by then.
    max_w, binding = caps.pulse_energy_j / width_s, PULSE_ENERGY
    dimmed_w = caps.power_share * budget.heat.power_max_w[request.stage]
    if caps.power_share < 1.0 and dimmed_w < max_w:
        max_w, binding = dimmed_w, DIM
    # The board's guard B6 keeps this bucket per cell. It leaks at the pixel's mean power, between pulses and within
    # them alike.
    spot_w = (caps.pulse_energy_j - bucket_j) / width_s
    if spot_w < max_w:
        max_w, binding = spot_w, SPOT_ENERGY
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
        max_w, binding = pixel_w, PIXEL_MEAN_POWER
    stage_w = max_window_power_w(
        workspace.stage_chains,
        request.stage,
        workspace.history,
        request.start_s,
        width_s,
        caps.display_window_s,
        caps.display_mean_w,
    )
    if stage_w < max_w:
        max_w, binding = stage_w, DISPLAY_MEAN_POWER
    wall_w, touch_w = slow_node_limits_w(budget, workspace.nodes, request, lower_bound_k)
    if wall_w < max_w:
        # A wall is held at the lower of both caps, and the answer names that one.
        max_w, binding = wall_w, WALL_TEMPERATURE if caps.wall_k < caps.touch_k else TOUCH_TEMPERATURE
    if touch_w < max_w:
        max_w, binding = touch_w, TOUCH_TEMPERATURE
    # Last, as it costs 32 evaluations where it binds, and none where a cheaper cap has trimmed enough.
    absorber_w = _max_absorber_power_w(budget, workspace, request, rise_k, min(max_w, request.power_w))
    if absorber_w < min(max_w, request.power_w):
        max_w, binding = absorber_w, ABSORBER_TEMPERATURE
    # An overdrawn bucket or window is negative; a negative power would mean a refusal.
    return max(0.0, max_w), binding


@kernel
def absorber_peak_k(
    budget: Budget, workspace: LimiterWorkspace, request: PulseRequest, rise_k: float, power_w: float
) -> float:
    """Return the peak bound on the absorber's rise above ambient during a pulse."""
    # Monotone within a pulse: hottest at one of its ends.
    own_k = max(rise_k, absorber_after_k(budget.heat, request.pixel, rise_k, power_w, request.width_s))
    wall_k = wall_peak_k(budget, workspace.nodes, request, power_w)
    return own_k + budget.heat.absorber_wall_factor * wall_k + budget.heat.absorber_per_panel * request.panel_k


@kernel
def _max_absorber_power_w(
    budget: Budget, workspace: LimiterWorkspace, request: PulseRequest, rise_k: float, requested_w: float
) -> float:
    """Return `requested_w` if it keeps the absorber within its cap, else the largest power that does, W."""
    cap_k = budget.caps.absorber_k
    if requested_w <= 0.0 or absorber_peak_k(budget, workspace, request, rise_k, requested_w) <= cap_k:
        return requested_w
    low_w, high_w = 0.0, requested_w
    for _ in range(BISECTIONS):
        middle_w = 0.5 * (low_w + high_w)
        if absorber_peak_k(budget, workspace, request, rise_k, middle_w) <= cap_k:
            low_w = middle_w
        else:
            high_w = middle_w
    return low_w


def compute_levels(state: BudgetState, budget: Budget, at_s: float) -> FloatArray:
    """Return how much of each cap is in use at `at_s`, with the gate off since the state's own time.

    Returns an array [caps + 1, p] by cap number, in units of `CapValues`; a cap of the whole display has the same level
    in every pixel, that of the stage with the highest, and a cap that does not accumulate is 0.
    """
    caps, pixels = budget.caps, len(state.rise_k)
    levels = np.zeros((len(CAPS) + 1, pixels))
    at_s = max(at_s, state.at_s)
    _fill_levels(budget, open_workspace(state, 0), at_s, levels)
    pixel_j = np.bincount(state.recent_pixel, _compute_window_energy_j(state, at_s, caps.pixel_window_s), pixels)
    levels[PIXEL_MEAN_POWER] = pixel_j / caps.pixel_window_s
    stage_j = np.bincount(state.recent_stage, _compute_window_energy_j(state, at_s, caps.display_window_s), 1)
    levels[DISPLAY_MEAN_POWER] = float(stage_j.max()) / caps.display_window_s
    # Ringing is left out: this is a gauge for people, the check of a move is not.
    decay = np.exp(-np.maximum(0.0, at_s - state.mirror_at_s) / budget.galvos.averaging_s)
    levels[GALVO_ACCELERATION] = float((state.galvo_mean_square.max(axis=1) * decay).max())
    return levels


def _compute_window_energy_j(state: BudgetState, at_s: float, window_s: float) -> FloatArray:
    """Return the energy of each recent pulse [r] within the window that ends at `at_s`, J."""
    begin_s = np.maximum(state.recent_start_s, at_s - window_s)
    end_s = np.minimum(state.recent_start_s + state.recent_width_s, at_s)
    return np.asarray(np.clip(end_s - begin_s, 0.0, None) * state.recent_power_w, dtype=np.float64)


@kernel
def _fill_levels(budget: Budget, workspace: LimiterWorkspace, at_s: float, levels: FloatArray) -> None:
    """Advance the workspace to `at_s` with the gate off, and fill in the levels that are kept per pixel."""
    heat, nodes = budget.heat, workspace.nodes
    exchange_wall_heat(heat, nodes, at_s, 0.0)
    panel_k = panel_peak_k(heat, nodes.panel_k, at_s - nodes.panel_at_s[0], 0.0)
    for pixel in range(levels.shape[1]):
        advance_pixel(heat, nodes, pixel, at_s)
        off_s = max(0.0, at_s - nodes.last_pulse_end_s[pixel])
        wall_k = wall_bound_k(heat, nodes, pixel)
        rise_k = absorber_after_k(heat, pixel, nodes.absorber_k[pixel], 0.0, off_s)
        touch_k = heat.touch_specht_ratio * max(nodes.touch_k[pixel, 0], nodes.touch_k[pixel, 1])
        levels[ABSORBER_TEMPERATURE, pixel] = (
            rise_k + heat.absorber_wall_factor * wall_k + heat.absorber_per_panel * panel_k
        )
        levels[WALL_TEMPERATURE, pixel] = wall_k + heat.wall_per_panel * panel_k
        touch_k += heat.touch_per_panel * panel_k
        levels[TOUCH_TEMPERATURE, pixel] = max(touch_k, levels[WALL_TEMPERATURE, pixel])
        levels[SPOT_ENERGY, pixel] = max(0.0, workspace.budgets.bucket_j[pixel] - off_s * budget.caps.pixel_mean_w)


class Usage(NamedTuple):
    """Use of one cap, in the unit of its `CapValues` field.

    pixel: the one with the highest use, None per display
    """

    cap: str
    used: float
    limit: float
    pixel: int | None


def compute_usage(state: BudgetState, budget: Budget, at_s: float) -> tuple[Usage, ...]:
    """Return the use of every gauged cap at `at_s`, on the state's time line, with the gate off since the state."""
    levels = compute_levels(state, budget, at_s)
    usages = []
    for cap in CAPS:
        if cap.is_gauged:
            level = levels[CAP_NUMBERS[cap.key]]
            pixel = int(level.argmax()) if cap.is_per_pixel else None
            usages.append(Usage(cap.key, float(level.max()), getattr(budget.caps, cap.field), pixel))
    return tuple(usages)


def compute_panel_k(state: BudgetState, budget: Budget, at_s: float) -> float:
    """Return the bound on the panel's rise at `at_s`, K, with the gate off since the state, or zero without a panel."""
    return float(panel_peak_k(budget.heat, state.panel_k, at_s - state.panel_at_s, 0.0))
