"""Plans on their way through the board, and notes of how far they came, for who looks on from another thread."""

from collections.abc import Iterable
from typing import NamedTuple

from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.link.session.plan_job import PlanJob


class PlanRun(NamedTuple):
    """A plan, and its points on their way."""

    record: PlanRecord
    job: PlanJob


class PlanProgress(NamedTuple):
    """Pulses begin to end of a run, in order of its points, are done, as far as they ever will be."""

    run: PlanRun
    begin: int
    end: int


class ClockShift(NamedTuple):
    """The board's clock was set anew: what was known happened so much later on it."""

    delay_s: float


def merge_events(events: Iterable[PlanProgress | ClockShift]) -> list[PlanProgress | ClockShift]:
    """The same notes, one for all that went on with a run: what is reckoned of them costs by the note."""
    merged: list[PlanProgress | ClockShift] = []
    for event in events:
        last = merged[-1] if merged else None
        if isinstance(event, PlanProgress) and isinstance(last, PlanProgress) and event.run.job is last.run.job:
            merged[-1] = last._replace(end=event.end)
        else:
            merged.append(event)
    return merged
