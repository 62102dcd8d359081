"""The nearest sets that fit: with lower heights, at a slower rate, or with pixels left out. Each is really planned."""

from math import ceil, sqrt

from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.feasibility.order_search import Orders, OrderSearch
from optodrive.planning.feasibility.sequence_edits import scale_sequence, stretch_sequence

TIME_FACTOR_MAX = 64.0
TIME_FACTOR_STEP = 1.01


def find_height_factor(search: OrderSearch, sequence: FrameSequence) -> tuple[float, Orders] | None:
    """The largest factor on all heights and powers, in hundredths, by halving; and the orders it fits with."""
    best: tuple[float, Orders] | None = None
    low, high = 0, 100
    while high - low > 1:
        middle = (low + high) // 2
        orders = search.find_orders(scale_sequence(sequence, middle / 100))
        if orders is None:
            high = middle
        else:
            low, best = middle, (middle / 100, orders)
    return best


def find_time_factor(search: OrderSearch, sequence: FrameSequence) -> tuple[float, Orders] | None:
    """The least factor on all times, to 1 %, by doubling and halving; and its orders. None beyond RATE_MAX."""
    low, high = 1.0, 2.0
    orders = search.find_orders(stretch_sequence(sequence, high))
    while orders is None:
        low, high = high, 2.0 * high
        if high > TIME_FACTOR_MAX or search.is_exhausted:
            return None
        orders = search.find_orders(stretch_sequence(sequence, high))
    while high > TIME_FACTOR_STEP * low and not search.is_exhausted:
        middle = ceil(100 * sqrt(low * high)) / 100
        if middle >= high:
            break
        shorter_orders = search.find_orders(stretch_sequence(sequence, middle))
        if shorter_orders is None:
            low = middle
        else:
            high, orders = middle, shorter_orders
    return high, orders
