"""Points of a job: when they may be sent."""

import numpy as np
import pytest

from optodrive.link.session.plan_job import PlanJob
from wire_points import build_points

START_TICK, AHEAD_TICKS, DUTY = 100_000, 20_000, 100


@pytest.mark.parametrize("holds_first", [True, False])
def test_each_point_waits_until_it_begins_soon_and_the_first_one_if_it_is_held(holds_first):
    points = build_points(5, DUTY)
    job = PlanJob(1, points, 30, START_TICK, AHEAD_TICKS, holds_first=holds_first)
    begins = [START_TICK, *(START_TICK + points.compute_end_ticks()[:-1]).tolist()]
    if not holds_first:
        assert (job.next_due_tick, job.count_sendable(0.0)) == (None, 1)
        job.take_payload(1, 0.0)
    for position, begin in list(enumerate(begins))[1 - holds_first :]:
        assert job.next_due_tick == begin - AHEAD_TICKS
        assert job.count_sendable(begin - AHEAD_TICKS - 0.5) == 0
        assert job.count_sendable(begin - AHEAD_TICKS) == 1
        assert job.can_truncate(position)
        job.take_payload(1, begin - AHEAD_TICKS)
        assert not job.can_truncate(position)
    assert job.next_due_tick is None


@pytest.mark.parametrize("kept", range(6))
def test_without_a_lead_all_that_is_kept_leaves_at_once(kept):
    job = PlanJob(1, build_points(5, DUTY), 30, START_TICK)
    job.truncate(kept)
    assert (job.count_sendable(0.0), job.next_due_tick) == (kept, None)
    assert job.end_tick_after(0) == START_TICK
    assert job.is_finished == (kept == 0)
    assert np.array_equal(job.pulse_rows, np.arange(5))
