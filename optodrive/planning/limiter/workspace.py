"""The mutable workspace of the kernels, built from an immutable `BudgetState` and converted back to one.

Its energy windows are exact for pulses of constant power in order of time: pulses that may still lie inside a window
form a linked chain, one per pixel and one per stage.
"""

from math import inf
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import BudgetState
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.heat_bound import ThermalNodes


class PulseHistory(NamedTuple):
    """Recent pulses, then those of the current plan, in order of time, [m]. The first n_valid [1] rows are valid."""

    start_s: FloatArray
    width_s: FloatArray
    power_w: FloatArray
    pixel: IntArray
    stage: IntArray
    n_valid: IntArray


class WindowChains(NamedTuple):
    """Chains through `PulseHistory`, one per row of c.

    first, last: [c] rows of the history, −1 for an empty chain; total_j: [c] energy of all pulses so far
    next_row: [m] row of the chain's next pulse, −1 for none; energy_before_j: [m] the chain's energy before a pulse
    """

    first: IntArray
    last: IntArray
    total_j: FloatArray
    next_row: IntArray
    energy_before_j: FloatArray


@kernel
def append(chains: WindowChains, chain: int, history: PulseHistory, row: int) -> None:
    """Append a pulse, which starts no earlier than the end of the chain's last pulse."""
    chains.next_row[row] = -1
    chains.energy_before_j[row] = chains.total_j[chain]
    chains.total_j[chain] += history.width_s[row] * history.power_w[row]
    if chains.first[chain] < 0:
        chains.first[chain] = row
    else:
        chains.next_row[chains.last[chain]] = row
    chains.last[chain] = row


@kernel
def max_window_power_w(
    chains: WindowChains,
    chain: int,
    history: PulseHistory,
    start_s: float,
    width_s: float,
    window_s: float,
    mean_w: float,
) -> float:
    """Return the largest power of a next pulse for which no window that ends within it exceeds window × mean, W.

    window_s, mean_w: length of the window, and the cap of the mean power over it.
    """
    row = chains.first[chain]
    # Starts only grow, so a pulse that no window reaches any more is skipped once and never visited again.
    while row >= 0 and history.start_s[row] + history.width_s[row] <= start_s - window_s:
        row = chains.next_row[row]
    chains.first[chain] = row
    # The energy in a window is piecewise linear in the window's end. During the pulse it can peak at the pulse's end,
    # or where the window's start meets the start of an earlier pulse.
    cap_j, total_j = window_s * mean_w, chains.total_j[chain]
    window_start_s = start_s + width_s - window_s
    expired_j = total_j if row < 0 else chains.energy_before_j[row]
    max_w = inf
    while row >= 0 and history.start_s[row] <= window_start_s:
        edge_s = history.start_s[row] + window_s
        if edge_s > start_s:
            max_w = min(max_w, (cap_j - (total_j - chains.energy_before_j[row])) / (edge_s - start_s))
        inside_s = min(window_start_s - history.start_s[row], history.width_s[row])
        expired_j = chains.energy_before_j[row] + history.power_w[row] * inside_s
        row = chains.next_row[row]
    return float(min(max_w, (cap_j - (total_j - expired_j)) / width_s))


T = TypeVar("T", bound=np.generic)


class PixelBudgets(NamedTuple):
    """Budgets of the pixels, and the state of every stage's beam. The arrays are modified.

    bucket_j, merged_width_s: [p] energy bucket, and total width of pulses without a gap, after the pixel's last pulse
    begun_s: [1] start of the last pulse; end_s: [k] end of each stage's last pulse
    peak_k: [p] largest bound on the absorber so far
    mirror_rad: [k, 2] mirror angles; galvo_mean_square, galvo_ringing: [k, 2], mirror_at_s: [k], see `GalvoState`
    """

    bucket_j: FloatArray
    merged_width_s: FloatArray
    begun_s: FloatArray
    end_s: FloatArray
    peak_k: FloatArray
    mirror_rad: FloatArray
    galvo_mean_square: FloatArray
    galvo_ringing: FloatArray
    mirror_at_s: FloatArray


class LimiterWorkspace(NamedTuple):
    """Everything that changes while a plan is applied.

    pixel_chains, stage_chains: one chain per pixel or stage
    """

    nodes: ThermalNodes
    budgets: PixelBudgets
    history: PulseHistory
    pixel_chains: WindowChains
    stage_chains: WindowChains


def open_workspace(state: BudgetState, capacity: int) -> LimiterWorkspace:
    """Return a workspace at `state` with capacity for that many more pulses."""
    pixels, past = len(state.rise_k), len(state.recent_start_s)
    nodes = ThermalNodes(
        absorber_k=state.rise_k.copy(),
        lower_bound_k=state.lower_bound_k.copy(),
        last_pulse_end_s=state.last_pulse_end_s.copy(),
        wall_k=state.wall_k.copy(),
        touch_k=state.touch_k.copy(),
        nodes_at_s=state.nodes_at_s.copy(),
        inflow_w=state.inflow_w.copy(),
        exchanged_at_s=np.array([state.exchanged_at_s]),
        panel_k=state.panel_k.copy(),
        panel_at_s=np.array([state.panel_at_s]),
        coarse_k=np.zeros(pixels),
        refined_k=np.zeros(pixels),
    )
    budgets = PixelBudgets(
        bucket_j=state.bucket_j.copy(),
        merged_width_s=state.merged_width_s.copy(),
        begun_s=np.array([state.begun_s]),
        end_s=state.beam_end_s.copy(),
        peak_k=np.zeros(pixels),
        mirror_rad=state.mirror_rad.copy(),
        galvo_mean_square=state.galvo_mean_square.copy(),
        galvo_ringing=state.galvo_ringing.copy(),
        mirror_at_s=state.mirror_at_s.copy(),
    )
    history = PulseHistory(
        start_s=_extend(state.recent_start_s, capacity),
        width_s=_extend(state.recent_width_s, capacity),
        power_w=_extend(state.recent_power_w, capacity),
        pixel=_extend(state.recent_pixel, capacity),
        stage=_extend(state.recent_stage, capacity),
        n_valid=np.array([past]),
    )
    chains = (_build_chains(count, past + capacity) for count in (pixels, len(state.beam_end_s)))
    workspace = LimiterWorkspace(nodes, budgets, history, *chains)
    _replay_history(workspace)
    return workspace


def _extend(past: NDArray[T], capacity: int) -> NDArray[T]:
    return np.concatenate([past, np.zeros(capacity, dtype=past.dtype)])


def _build_chains(count: int, pulses: int) -> WindowChains:
    return WindowChains(
        first=np.full(count, -1),
        last=np.full(count, -1),
        total_j=np.zeros(count),
        next_row=np.full(pulses, -1),
        energy_before_j=np.zeros(pulses),
    )


def close_workspace(workspace: LimiterWorkspace, budget: Budget) -> BudgetState:
    """Return the state for the next plan, without pulses that no future window contains."""
    nodes, budgets, history = workspace.nodes, workspace.budgets, workspace.history
    at_s, count = float(budgets.end_s.max()), int(history.n_valid[0])
    # From the last start, not the last end: a pulse of another stage may still begin before that end.
    horizon_s = float(budgets.begun_s[0]) - max(budget.caps.pixel_window_s, budget.caps.display_window_s)
    recent = np.flatnonzero(history.start_s[:count] + history.width_s[:count] > horizon_s)
    return BudgetState(
        at_s=at_s,
        begun_s=float(budgets.begun_s[0]),
        last_pulse_end_s=nodes.last_pulse_end_s,
        rise_k=nodes.absorber_k,
        lower_bound_k=nodes.lower_bound_k,
        bucket_j=budgets.bucket_j,
        merged_width_s=budgets.merged_width_s,
        wall_k=nodes.wall_k,
        touch_k=nodes.touch_k,
        nodes_at_s=nodes.nodes_at_s,
        inflow_w=nodes.inflow_w,
        exchanged_at_s=float(nodes.exchanged_at_s[0]),
        panel_k=nodes.panel_k,
        panel_at_s=float(nodes.panel_at_s[0]),
        beam_end_s=budgets.end_s,
        mirror_rad=budgets.mirror_rad,
        galvo_mean_square=budgets.galvo_mean_square,
        galvo_ringing=budgets.galvo_ringing,
        mirror_at_s=budgets.mirror_at_s,
        recent_start_s=history.start_s[recent],
        recent_width_s=history.width_s[recent],
        recent_power_w=history.power_w[recent],
        recent_pixel=history.pixel[recent],
        recent_stage=history.stage[recent],
    )


@kernel
def _replay_history(workspace: LimiterWorkspace) -> None:
    """Append the pulses of earlier plans to the chains."""
    for row in range(workspace.history.n_valid[0]):
        append(workspace.pixel_chains, workspace.history.pixel[row], workspace.history, row)
        append(workspace.stage_chains, workspace.history.stage[row], workspace.history, row)
