"""The plans of the queue, their pulses and their ends.

`PulseAccounts` says how many pulses were planned, sent and executed, when, and with which error; events on the progress
of running plans go to one reader in another thread.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray
from optodrive.daemon.engine.active_plan import ActivePlan, simulate_plan
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.thermal_estimate import HOLD_MAX_S, QueueThermal, ThermalEstimate
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.service.control import BEAT_AGE_MAX_S
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.clock_sync import TimingTotals, compute_timing_error
from optodrive.link.session.group_state import LostStage
from optodrive.link.session.staged_job import StagedJob
from optodrive.planning.display_model import DisplayModel


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


MIN_DELAY_S = 1e-5


class QueuedPlans:
    """Plans that run on the board or wait for it. `lock` guards both deques and the thermal estimate.

    on_progress: called during long computations in the loop's thread
    accounts: what has become of the pulses; thermal: heat and budget after all plans
    """

    def __init__(self, display: DisplayModel, session: RemoteSession, executor: Executor) -> None:
        self.lock = threading.RLock()
        self.on_progress: Callable[[], None] = lambda: None
        self.running: deque[PlanRun] = deque()
        self.waiting: deque[ActivePlan] = deque()
        self.accounts = PulseAccounts(session)
        self.thermal = QueueThermal(display, session, lambda: self.on_progress())
        self._session = session
        self._executor = executor

    @property
    def is_busy(self) -> bool:
        """Whether a plan runs or waits."""
        return bool(self.running or self.waiting)

    def count_pulses(self) -> int:
        """Count the pulses of all running and waiting plans."""
        running = [run.plan for run in self.running.copy()]
        return sum(plan.record.pulse_count for plan in (*running, *self.waiting.copy()))

    def list_active(self) -> list[ActivePlan]:
        """Return the running plans, or the first that waits."""
        return [run.plan for run in self.running] or list(self.waiting)[:1]

    def cancel(self, record: PlanRecord, reason: str = "") -> None:
        """Remove a waiting plan, or turn the gate off and end a running plan with its splices. reason: for people."""
        plan = next((plan for plan in self.waiting if plan.record is record), None)
        if plan is not None:
            with self.lock:
                behind = list(self.waiting)[self.waiting.index(plan) + 1 :]
                self.waiting.remove(plan)
                if not plan.is_interrupted:
                    self.thermal.forget(plan, behind)
                else:
                    self.thermal.rewind([plan], behind)
            self.end_waiting(plan, PlanStatus.CANCELLED, reason or "removed from the queue")
        elif any(run.plan.record is record for run in self.running):
            self._session.flush()
            self.end_running(PlanStatus.CANCELLED, reason or "cancelled while running")

    def end_running(self, status: PlanStatus, error: str | None, clock_shift_s: float = 0.0) -> None:
        """End all running plans and record their executed pulses. clock_shift_s: as for end_all."""
        with self.lock:
            ended = list(self.running)
            self.running.clear()
            for run in ended:
                self.conclude(run, status, error)
            self.delay_all(max((run.plan.record.delay_s for run in ended), default=0.0))
            if ended:
                self.thermal.rewind([run.plan for run in ended], self.waiting, clock_shift_s)

    def end_all(self, status: PlanStatus, reason: str, clock_shift_s: float = 0.0) -> None:
        """End all running and waiting plans.

        clock_shift_s: by which the board's clock has jumped since they were queued, see PlanQueue.on_board_restarted
        """
        with self.lock:
            waiting = list(self.waiting)
            self.waiting.clear()
            if self.running:
                self.end_running(status, reason, clock_shift_s)
            elif waiting:
                self.thermal.rewind(waiting[:1], clock_shift_s=clock_shift_s)
        for plan in waiting:
            self.end_waiting(plan, status, reason)

    def build_final_estimate(self) -> ThermalEstimate:
        """Return the estimate after the end of this process, with which the link process ends all plans.

        Each pulse that may have started by then counts, up to the longest time late that the board permits.
        """
        with self.lock:
            active = self.list_active()
            if active:
                self.thermal.rewind(active, notice_s=BEAT_AGE_MAX_S)
                self.thermal.delay(HOLD_MAX_S + max(plan.record.delay_s for plan in active))
            return self.thermal.estimate

    def end_waiting(self, plan: ActivePlan, status: PlanStatus, error: str | None) -> None:
        """End a plan that does not run and was removed from the queue."""
        plan.update_execution()
        plan.end(status, error)
        if plan.executed is not None:
            self._executor.submit(simulate_plan, plan, status, error)

    def conclude(self, run: PlanRun, status: PlanStatus, error: str | None) -> None:
        """End a plan that ran and was removed from the queue, now or after the simulation of its executed pulses."""
        plan, record = run.plan, run.plan.record
        self.accounts.collect_executed(run)
        plan.update_execution()
        if record.timing_error is not None:
            self.accounts.timing.add(record.timing_error)
        if status in (PlanStatus.STOPPED, PlanStatus.FAILED, PlanStatus.CANCELLED):
            plan.end(status, error)
        self._executor.submit(simulate_plan, plan, status, error)

    def delay_all(self, delay_s: float) -> None:
        """Shift all plans, and the heat after them, because one was late by more than MIN_DELAY_S."""
        if delay_s <= MIN_DELAY_S:
            return
        with self.lock:
            self.thermal.delay(delay_s)
            for plan in (*(run.plan for run in self.running), *self.waiting):
                plan.record.start_s += delay_s
            for run in self.running:
                run.job.delay(round(delay_s / self._session.tick_s))
