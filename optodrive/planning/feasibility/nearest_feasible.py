"""Nearest feasible variants with lower heights or longer times, each confirmed by a plan."""

from math import ceil, sqrt

from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.feasibility.order_search import Orders, OrderSearch
from optodrive.planning.feasibility.sequence_edits import scale_sequence, stretch_sequence

TIME_FACTOR_MAX = 64.0
"""Largest time factor tried."""
TIME_FACTOR_STEP = 1.01
"""Ratio of the bracket's ends at which the search for the time factor stops."""


def find_height_factor(search: OrderSearch, sequence: FrameSequence) -> tuple[float, Orders] | None:
    """Find the largest factor on all heights and powers that fits, by bisection in hundredths.

    Returns the factor and the visiting orders, or None if no factor fits.
    """
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
    """Find the smallest factor on all times that fits, by doubling and bisection to within 1 %.

    Returns the factor and the visiting orders, or None if no factor up to TIME_FACTOR_MAX fits.
    """
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
