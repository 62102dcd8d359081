"""Running plans, and events on their progress for a reader in another thread."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.link.session.group_state import LostStage
from optodrive.link.session.staged_job import StagedJob


class PlanRun(NamedTuple):
    """Running plan with its job."""

    plan: ActivePlan
    job: StagedJob


def find_emitted(run: PlanRun, lost: LostStage) -> BoolArray:
    """Return which rows of a plan were executed, or may have been by the board of a lost stage before it was dark, [n].

    Nothing is known of what that board was sent for this time.
    """
    plan = run.plan
    start_s = plan.record.start_s + plan.planned.plan.start_s
    emitted = np.arange(len(start_s)) < plan.first_row
    emitted[plan.executed_rows] = True
    sent = run.job.parts[lost.stage].list_sent_rows()
    emitted[sent[start_s[sent] <= lost.dark_s]] = True
    return emitted


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
