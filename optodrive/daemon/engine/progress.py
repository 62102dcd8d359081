"""Running plans, and events on their progress for a reader in another thread."""

from collections.abc import Iterable
from typing import NamedTuple

from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.link.session.staged_job import StagedJob


class PlanRun(NamedTuple):
    """Running plan with its job."""

    plan: ActivePlan
    job: StagedJob


class PlanProgress(NamedTuple):
    """Event: pulses begin to end of a run, in order of its points, were executed or will never be."""

    run: PlanRun
    begin: int
    end: int


class ClockShift(NamedTuple):
    """Event: the board's clock restarted, and earlier events happened delay_s later on it."""

    delay_s: float


def merge_events(events: Iterable[PlanProgress | ClockShift]) -> list[PlanProgress | ClockShift]:
    """Merge consecutive progress events of a run, because the cost of processing is per event."""
    merged: list[PlanProgress | ClockShift] = []
    for event in events:
        last = merged[-1] if merged else None
        if isinstance(event, PlanProgress) and isinstance(last, PlanProgress) and event.run.job is last.run.job:
            merged[-1] = last._replace(end=event.end)
        else:
            merged.append(event)
    return merged
