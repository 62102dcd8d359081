"""Energy within every window of a given length, exact for pulses of constant power in order of time. Kernels.

Pulses that may still lie inside a window form a linked chain: one chain per pixel and one per stage.
"""

from math import inf
from typing import NamedTuple

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray, IntArray


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
