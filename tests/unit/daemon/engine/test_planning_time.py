"""Time reserved for the planning of a streamed plan."""

import pytest

from optodrive.daemon.engine.planner import FACTOR, INITIAL_S, RECENT_MAX, PlanningTime


def test_one_exceptional_planning_reserves_nothing():
    planning_time = PlanningTime()
    assert planning_time.compute_reserved_s(0) == pytest.approx(FACTOR * INITIAL_S)
    for duration_s in [0.004] * RECENT_MAX + [0.2]:
        planning_time.record(duration_s)
    assert planning_time.compute_reserved_s(0) == pytest.approx(FACTOR * 0.004)


def test_two_long_ones_do_until_they_are_old():
    planning_time = PlanningTime()
    for duration_s in (0.004, 0.02, 0.004, 0.03):
        planning_time.record(duration_s)
    assert planning_time.compute_reserved_s(0) == pytest.approx(FACTOR * 0.02)
    for _ in range(RECENT_MAX):
        planning_time.record(0.004)
    assert planning_time.compute_reserved_s(0) == pytest.approx(FACTOR * 0.004)


def test_a_late_plan_reserves_more():
    planning_time = PlanningTime()
    assert planning_time.compute_reserved_s(1) == pytest.approx(2 * planning_time.compute_reserved_s(0))
