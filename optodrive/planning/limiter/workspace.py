"""BudgetState, which is kept and never changes, to the ledger that a walk writes to, and back."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from optodrive.core.types.plans import BudgetState
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.energy_windows import Chains, Pulses
from optodrive.planning.limiter.heat_bound import Nodes
from optodrive.planning.limiter.pulse_application import Ledger, Spots, replay

T = TypeVar("T", bound=np.generic)


def open_ledger(state: BudgetState, room: int) -> Ledger:
    """A ledger at `state` with room for so many more pulses."""
    pixels, past = len(state.rise_k), len(state.recent_start_s)
    nodes = Nodes(
        absorber_k=state.rise_k.copy(),
        least_k=state.least_k.copy(),
        dark_since_s=state.dark_since_s.copy(),
        wall_k=state.wall_k.copy(),
        touch_k=state.touch_k.copy(),
        nodes_at_s=state.nodes_at_s.copy(),
        inflow_w=state.inflow_w.copy(),
        exchanged_at_s=np.array([state.exchanged_at_s]),
        crude_k=np.zeros(pixels),
        firm_k=np.zeros(pixels),
    )
    spots = Spots(
        bucket_j=state.spot_j.copy(),
        on_s=state.on_s.copy(),
        end_s=np.array([state.at_s]),
        peak_k=np.zeros(pixels),
        mirror_rad=state.mirror_rad.copy(),
        acceleration2=state.acceleration2.copy(),
        swing=state.swing.copy(),
        mirror_at_s=np.array([state.mirror_at_s]),
    )
    pulses = Pulses(
        start_s=_with_room(state.recent_start_s, room),
        width_s=_with_room(state.recent_width_s, room),
        power_w=_with_room(state.recent_power_w, room),
        pixel=_with_room(state.recent_pixel, room),
        fired=np.array([past]),
    )
    ledger = Ledger(nodes, spots, pulses, _chains(pixels, past + room), _chains(1, past + room))
    replay(ledger)
    return ledger


def _with_room(past: NDArray[T], room: int) -> NDArray[T]:
    return np.concatenate([past, np.zeros(room, dtype=past.dtype)])


def _chains(count: int, pulses: int) -> Chains:
    return Chains(
        first=np.full(count, -1),
        last=np.full(count, -1),
        total_j=np.zeros(count),
        following=np.full(pulses, -1),
        before_j=np.zeros(pulses),
    )


def close_ledger(ledger: Ledger, budget: Budget) -> BudgetState:
    """Everything a next plan must know; pulses that no window can reach any more are forgotten."""
    nodes, spots, pulses = ledger.nodes, ledger.spots, ledger.pulses
    at_s, count = float(spots.end_s[0]), int(pulses.fired[0])
    horizon_s = at_s - max(budget.caps.pixel_window_s, budget.caps.display_window_s)
    kept = np.flatnonzero(pulses.start_s[:count] + pulses.width_s[:count] > horizon_s)
    return BudgetState(
        at_s=at_s,
        dark_since_s=nodes.dark_since_s,
        rise_k=nodes.absorber_k,
        least_k=nodes.least_k,
        spot_j=spots.bucket_j,
        on_s=spots.on_s,
        wall_k=nodes.wall_k,
        touch_k=nodes.touch_k,
        nodes_at_s=nodes.nodes_at_s,
        inflow_w=nodes.inflow_w,
        exchanged_at_s=float(nodes.exchanged_at_s[0]),
        mirror_rad=spots.mirror_rad,
        acceleration2=spots.acceleration2,
        swing=spots.swing,
        mirror_at_s=float(spots.mirror_at_s[0]),
        recent_start_s=pulses.start_s[kept],
        recent_width_s=pulses.width_s[kept],
        recent_power_w=pulses.power_w[kept],
        recent_pixel=pulses.pixel[kept],
    )
