"""Notes of what was done, joined: one for what went on with a run, in order, and never over something else between."""

from optodrive.daemon.engine.progress import ClockShift, PlanProgress, PlanRun, merge_events


def test_what_follows_on_is_one_note_and_nothing_is_lost_or_moved():
    first, second = (PlanRun(record, job) for record, job in ((object(), object()), (object(), object())))
    again = PlanRun(first.record, first.job)  # a run may be told of by another tuple
    notes = [
        PlanProgress(first, 0, 3),
        PlanProgress(again, 3, 9),
        PlanProgress(second, 0, 1),
        PlanProgress(first, 9, 10),
        ClockShift(-2.0),
        PlanProgress(first, 10, 12),
        PlanProgress(first, 12, 20),
    ]
    assert merge_events(notes) == [
        PlanProgress(first, 0, 9),
        PlanProgress(second, 0, 1),
        PlanProgress(first, 9, 10),
        ClockShift(-2.0),
        PlanProgress(first, 10, 20),
    ]
    assert merge_events([]) == []
