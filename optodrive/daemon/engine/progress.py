"""Running plans, events on their progress for a reader in another thread, and accounts of their pulses.

The accounts say how many pulses were planned, sent and executed, when, and with which error.
"""

from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.clock_sync import TimingTotals, compute_timing_error
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


EVENTS_MAX = 4000
"""Maximum number of events without a reader, 20 s at least. An event keeps its plan in memory."""


class PulseAccounts:
    """Totals over all plans, and the records of running plans. Only the loop's thread changes them.

    totals: numbers of pulses planned, sent and executed; timing: largest errors of their times
    events: executed pulses and clock shifts, newest last, for one reader in another thread that removes them
    """

    def __init__(self, session: RemoteSession) -> None:
        self.totals = {"planned": 0, "sent": 0, "executed": 0}
        self.timing = TimingTotals()
        self.events: deque[PlanProgress | ClockShift] = deque(maxlen=EVENTS_MAX)
        self._session = session

    def count_progress(self, run: PlanRun) -> None:
        """Count the pulses of a running plan that were sent and executed since the last call."""
        record, job, before = run.plan.record, run.job, run.plan.executed_before
        sent, executed = before + job.sent_count, before + job.executed_count
        if executed > record.executed_count:
            progress = PlanProgress(run, record.executed_count - before, job.executed_count)
            self.events.append(progress)
            if record.onset is None:
                self._record_onset(progress)
        self.totals["sent"] += sent - record.sent
        self.totals["executed"] += executed - record.executed_count
        record.sent, record.executed_count = sent, executed

    def count_executed(self, plan: ActivePlan) -> None:
        """Count all executed pulses of an interrupted plan, also those behind a gap that the lost board has left."""
        record, executed = plan.record, plan.executed_before
        self.totals["executed"] += executed - record.executed_count
        record.executed_count = executed

    def _record_onset(self, progress: PlanProgress) -> None:
        """Convert the time of the first gate on as soon as it is reported: later, the clocks would have drifted."""
        (plan, job), begin, end = progress
        reported, clocks = job.read_reported(begin, end, self._session.scales), self._session.read_clocks()
        on_tick = reported.on_tick[reported.on_ticks > 0]
        if len(on_tick) and clocks is not None:
            plan.record.onset = clocks.convert(float(on_tick[0]) * self._session.tick_s)

    def collect_executed(self, run: PlanRun) -> None:
        """Take the executed pulses of a job into its plan. The job ends with that, or is interrupted."""
        self.count_progress(run)  # reports may have arrived with what ends the job
        plan, job = run
        record, start_s, scales = plan.record, plan.planned.plan.start_s, self._session.scales
        if job.executed_count < job.pulse_count:
            self.events.append(PlanProgress(run, job.executed_count, job.pulse_count))
        executed = job.build_executed(plan.planned.plan, scales)
        plan.add_executed(executed, job.list_executed_rows())
        if job.first_sent_tick is not None and record.first_byte_after_s is None:
            record.first_byte_after_s = job.first_sent_tick * self._session.tick_s - record.arrived_s
        if plan.executed is not None and plan.executed_rows is not None and len(plan.executed):
            executed, rows = plan.executed, plan.executed_rows
            light_s = executed.start_s[executed.width_s > 0.0]
            if len(light_s):
                record.first_light_after_s = record.start_s + float(light_s[0]) - record.arrived_s
            if len(scales) == 1:  # several boards drop what would come late
                record.delay_s = float(executed.start_s[-1] - start_s[rows[-1]])
            record.timing_error = compute_timing_error(start_s[rows], executed.start_s)
