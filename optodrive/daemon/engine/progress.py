"""Plans on their way through the board, and notes of how far they came, for who looks on from another thread."""

from collections.abc import Iterable
from typing import NamedTuple

from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.link.session.job import Job


class Run(NamedTuple):
    """A plan, and its points on their way."""

    record: PlanRecord
    job: Job


class Progress(NamedTuple):
    """Pulses begin to end of a run, in order of its points, are done, as far as they ever will be."""

    run: Run
    begin: int
    end: int


class ClockMoved(NamedTuple):
    """The board's clock was set anew: what was known happened so much later on it."""

    delay_s: float


def joined(notes: Iterable[Progress | ClockMoved]) -> list[Progress | ClockMoved]:
    """The same notes, one for all that went on with a run: what is reckoned of them costs by the note."""
    whole: list[Progress | ClockMoved] = []
    for note in notes:
        last = whole[-1] if whole else None
        if isinstance(note, Progress) and isinstance(last, Progress) and note.run.job is last.run.job:
            whole[-1] = last._replace(end=note.end)
        else:
            whole.append(note)
    return whole
