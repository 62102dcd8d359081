"""Energy within any window of a given length, exact for pulses of constant power in order of time. Kernels.

Pulses that may still lie inside a window form a chain: one for each pixel, one for the display.
"""

from math import inf
from typing import NamedTuple

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray, IntArray


class Pulses(NamedTuple):
    """Pulses fired lately, then those of the plan in hand, in order of time; fired [1] of them are valid. All [m]."""

    start_s: FloatArray
    width_s: FloatArray
    power_w: FloatArray
    pixel: IntArray
    fired: IntArray


class Chains(NamedTuple):
    """Chains through `Pulses`, one a row of c. first, last: [c] index, −1 where empty; total_j: [c] energy so far.

    following: [m] the chain's next pulse, −1 for none; before_j: [m] the chain's energy before a pulse.
    """

    first: IntArray
    last: IntArray
    total_j: FloatArray
    following: IntArray
    before_j: FloatArray


@kernel
def append(chains: Chains, chain: int, pulses: Pulses, row: int) -> None:
    """Count a pulse; it starts no earlier than the chain's last one ended."""
    chains.following[row] = -1
    chains.before_j[row] = chains.total_j[chain]
    chains.total_j[chain] += pulses.width_s[row] * pulses.power_w[row]
    if chains.first[chain] < 0:
        chains.first[chain] = row
    else:
        chains.following[chains.last[chain]] = row
    chains.last[chain] = row


@kernel
def allowed_w(
    chains: Chains, chain: int, pulses: Pulses, start_s: float, width_s: float, window_s: float, mean_w: float
) -> float:
    """Largest power of a next pulse that keeps every window ending within it at or below window × mean."""
    row = chains.first[chain]
    while row >= 0 and pulses.start_s[row] + pulses.width_s[row] <= start_s - window_s:
        row = chains.following[row]
    chains.first[chain] = row
    # The energy in a window that ends during the pulse is piecewise linear in its end: it can peak at the pulse's
    # end, or where the window's far edge meets the start of an earlier pulse.
    cap_j, total_j = window_s * mean_w, chains.total_j[chain]
    far_s = start_s + width_s - window_s
    gone_j = total_j if row < 0 else chains.before_j[row]
    most_w = inf
    while row >= 0 and pulses.start_s[row] <= far_s:
        meets_s = pulses.start_s[row] + window_s
        if meets_s > start_s:
            most_w = min(most_w, (cap_j - (total_j - chains.before_j[row])) / (meets_s - start_s))
        inside_s = min(far_s - pulses.start_s[row], pulses.width_s[row])
        gone_j = chains.before_j[row] + pulses.power_w[row] * inside_s
        row = chains.following[row]
    return float(min(most_w, (cap_j - (total_j - gone_j)) / width_s))
