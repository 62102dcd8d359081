"""The nearest sets that fit: with lower heights, at a slower rate, or with pixels left out. Each is really planned."""

from math import ceil, sqrt

from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.feasibility.order_search import Orders, Trials
from optodrive.planning.feasibility.sequence_edits import scaled, stretched

RATE_MAX = 64.0
RATE_STEP = 1.01


def lower(trials: Trials, sequence: FrameSequence) -> tuple[float, Orders] | None:
    """The largest factor on all heights and powers, in hundredths, by halving; and the orders it fits with."""
    best: tuple[float, Orders] | None = None
    low, high = 0, 100
    while high - low > 1:
        middle = (low + high) // 2
        orders = trials.found(scaled(sequence, middle / 100))
        if orders is None:
            high = middle
        else:
            low, best = middle, (middle / 100, orders)
    return best


def slower(trials: Trials, sequence: FrameSequence) -> tuple[float, Orders] | None:
    """The least factor on all times, to 1 %, by doubling and halving; and its orders. None beyond RATE_MAX."""
    low, high = 1.0, 2.0
    orders = trials.found(stretched(sequence, high))
    while orders is None:
        low, high = high, 2.0 * high
        if high > RATE_MAX or trials.spent:
            return None
        orders = trials.found(stretched(sequence, high))
    while high > RATE_STEP * low and not trials.spent:
        middle = ceil(100 * sqrt(low * high)) / 100
        if middle >= high:
            break
        slow = trials.found(stretched(sequence, middle))
        if slow is None:
            low = middle
        else:
            high, orders = middle, slow
    return high, orders
