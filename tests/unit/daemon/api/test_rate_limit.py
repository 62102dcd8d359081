from hypothesis import given
from hypothesis import strategies as st

from optodrive.daemon.api.access_policy import CALLERS_MAX, RateLimiter


def test_a_burst_then_the_rate():
    rates = RateLimiter(10.0, 5)
    assert [rates.acquire("a", 0.0) for _ in range(5)] == [0.0] * 5
    assert rates.acquire("a", 0.0) == 0.1
    assert rates.acquire("b", 0.0) == 0.0
    assert rates.acquire("a", 0.1001) == 0.0
    assert rates.acquire("a", 0.1001) > 0.0


@given(st.lists(st.floats(0.0, 0.3), min_size=1, max_size=200), st.floats(1.0, 50.0), st.integers(1, 20))
def test_accepted_requests_never_exceed_burst_and_rate(gaps, per_s, burst):
    rates, now_s, answered = RateLimiter(per_s, burst), 0.0, 0
    for gap in gaps:
        now_s += gap
        answered += rates.acquire("a", now_s) == 0.0
        assert answered <= burst + per_s * now_s + 1e-6


@given(st.floats(1.0, 100.0), st.integers(1, 10))
def test_a_request_after_the_returned_wait_is_accepted(per_s, burst):
    rates, now_s = RateLimiter(per_s, burst), 0.0
    for _ in range(burst + 20):
        wait_s = rates.acquire("a", now_s)
        if wait_s:
            now_s += wait_s + 1e-9
            assert rates.acquire("a", now_s) == 0.0


def test_the_number_of_buckets_is_bounded():
    rates = RateLimiter(1.0, 1)
    for caller in range(3 * CALLERS_MAX):
        rates.acquire(caller, 0.0)
    assert len(rates._buckets) == CALLERS_MAX
