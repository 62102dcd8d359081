"""The line through recent exchanges with a board's clock."""

import numpy as np
import pytest

from optodrive.link.session.clock_sync import ClockSync
from optodrive.link.simulator.board_core import BoardClock

CLOCKS = [BoardClock(60e-6, 0.0, 5.0), BoardClock(-40e-6, 10e-6), BoardClock()]


def compare(clock, count, seed=1, width_s=3e-4):
    """Return the comparison after `count` exchanges, and the host time of the last."""
    rng, sync = np.random.default_rng(seed), ClockSync(0.25)
    sent_s = 0.0
    for k in range(count):
        sent_s = 1000.0 + 0.25 * k
        there_s, back_s = width_s * rng.uniform(0.3, 1.0, 2) * rng.choice([1.0, 10.0], p=[0.9, 0.1])
        sync.finish_exchange(sync.start_exchange(sent_s), sent_s + there_s + back_s, clock.read_s(sent_s + there_s))
    return sync, sent_s


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("count", [2, 8, 64, 300])
def test_the_error_is_within_its_bound(clock, count):
    sync, last_s = compare(clock, count)
    fit = sync.fit(last_s + 0.2)
    error_s = fit.to_board_s(last_s + 0.2) - clock.read_s(last_s + 0.2)
    assert abs(error_s) < fit.uncertainty_s < 1e-3
    assert fit.to_host_s(fit.to_board_s(1234.5)) == pytest.approx(1234.5, abs=1e-9)


def test_repeated_exchanges_leave_the_narrowest_of_each_interval():
    """A hundred wide ones within two seconds neither displace a narrow one nor the knowledge of the rate."""
    clock = CLOCKS[0]
    sync, last_s = compare(clock, 64)
    before = sync.fit(last_s)
    for k in range(100):
        sent_s = last_s + 0.25 + 0.02 * k
        sync.finish_exchange(sync.start_exchange(sent_s), sent_s + 0.02, clock.read_s(sent_s))
    after_s = last_s + 2.25
    assert sync.fit(after_s).uncertainty_s < 5e-4
    assert sync.fit(after_s).rate == pytest.approx(before.rate, abs=2e-6)


def test_after_some_seconds_the_rate_is_known():
    for clock in CLOCKS[::2]:
        sync, last_s = compare(clock, 64)
        assert sync.fit(last_s).rate - 1.0 == pytest.approx(clock.drift, abs=8e-6)
        assert abs(sync.fit(last_s).to_board_s(last_s) - clock.read_s(last_s)) < 6e-5


def test_without_an_exchange_nothing_is_known():
    assert ClockSync().fit(1.0) is None


def test_a_board_clock_is_inverted():
    clock = BoardClock(90e-6, 50e-6, 12.0)
    for true_s in (0.0, 17.3, 599.0, 12345.6):
        assert clock.find_true_s(clock.read_s(true_s)) == pytest.approx(true_s, abs=1e-9)
