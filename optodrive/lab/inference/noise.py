"""White noise of samples beside a signal that is smooth from sample to sample."""

from collections.abc import Iterable, Sequence
from math import comb, sqrt

import numpy as np

from optodrive.core.types.arrays import FloatArray


def estimate_noise(parts: Iterable[FloatArray], orders: Sequence[int], *, stride: int = 1, few: int = 1) -> float:
    """Return the standard deviation of white noise, the smallest estimate by differences of these orders, or 0.

    Those of order n vanish for a signal that is a polynomial of degree n − 1 over n + 1 samples: a high order for an
    oscillation of few samples per period, a low one beside steps and gaps. Medians are robust against steps.

    parts: samples at equal distances, NaN where one is missing; stride: samples from one to the next that count;
    few: smallest number of differences of an order
    """
    estimates, differences = [], list(parts)
    for order in range(1, max(orders) + 1):
        differences = [part[stride:] - part[:-stride] for part in differences]
        if order in orders:
            joined = np.concatenate(differences)
            joined = joined[np.isfinite(joined)]
            if len(joined) >= few:
                estimates.append(1.4826 * float(np.median(np.abs(joined))) / sqrt(comb(2 * order, order)))
    return min(estimates, default=0.0)
