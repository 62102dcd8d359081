"""Merging of progress events: one per uninterrupted sequence of a run, in order."""

from optodrive.daemon.engine.metrics import ClockShift, PlanProgress, merge_events
from optodrive.daemon.engine.queue_state import PlanRun


def test_consecutive_events_of_a_run_are_merged_and_nothing_is_lost_or_reordered():
    first, second = (PlanRun(plan, job) for plan, job in ((object(), object()), (object(), object())))
    again = PlanRun(first.plan, first.job)  # another tuple for the same run
    events = [
        PlanProgress(first, 0, 3),
        PlanProgress(again, 3, 9),
        PlanProgress(second, 0, 1),
        PlanProgress(first, 9, 10),
        ClockShift(-2.0),
        PlanProgress(first, 10, 12),
        PlanProgress(first, 12, 20),
    ]
    assert merge_events(events) == [
        PlanProgress(first, 0, 9),
        PlanProgress(second, 0, 1),
        PlanProgress(first, 9, 10),
        ClockShift(-2.0),
        PlanProgress(first, 10, 20),
    ]
    assert merge_events([]) == []
