"""The plans of the queue, and how they end."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor

from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.plan_simulation import simulate_plan
from optodrive.daemon.engine.progress import PlanRun, PulseAccounts
from optodrive.daemon.engine.queue_thermal import HOLD_MAX_S, QueueThermal
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.service.control import BEAT_AGE_MAX_S
from optodrive.link.service.remote_session import RemoteSession
from optodrive.planning.display_model import DisplayModel

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
