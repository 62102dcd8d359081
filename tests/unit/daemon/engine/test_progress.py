"""Notes of what was done, joined: one for what went on with a run, in order, and never over something else between."""

from optodrive.daemon.engine.progress import ClockMoved, Progress, Run, joined


def test_what_follows_on_is_one_note_and_nothing_is_lost_or_moved():
    first, second = (Run(record, job) for record, job in ((object(), object()), (object(), object())))
    again = Run(first.record, first.job)  # a run may be told of by another tuple
    notes = [
        Progress(first, 0, 3),
        Progress(again, 3, 9),
        Progress(second, 0, 1),
        Progress(first, 9, 10),
        ClockMoved(-2.0),
        Progress(first, 10, 12),
        Progress(first, 12, 20),
    ]
    assert joined(notes) == [
        Progress(first, 0, 9),
        Progress(second, 0, 1),
        Progress(first, 9, 10),
        ClockMoved(-2.0),
        Progress(first, 10, 20),
    ]
    assert joined([]) == []
