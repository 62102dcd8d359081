from functools import reduce
from operator import add

from hypothesis import given
from hypothesis import strategies as st

from optodrive.core.histogram import Histogram

BOUNDS = (0.1, 1.0, 10.0)


@given(st.lists(st.floats(0, 100)))
def test_it_counts_values_at_most_each_bound(values):
    histogram = Histogram(BOUNDS)
    for value in values:
        histogram.add(value)
    counts = [sum(value <= bound for value in values) for bound in BOUNDS]
    assert histogram.cumulative_counts() == [*counts, len(values)]
    assert histogram.sum == reduce(add, values, 0.0)
