"""Pause of the queue: keeps plans from starting until they are limited and proven again.

The board drops its queue; what was not executed becomes the rest of the same plan, which waits at the front and
is limited again for the time at which the light returns (decision 37). A stream is dropped, as it shows the present.
The loss of a stage, where the others go on, interrupts as a pause does. Nobody knows what the lost board emitted: what
it was sent for the time before it was dark for certain counts, and is not repeated. What is left is planned anew, also
that of a stream, unless a newer frame waits already (decision 49).
"""

from collections.abc import Callable
from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import NotReadyError
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.plan_restart import RestartedPlan, restart_plans
from optodrive.daemon.engine.progress import PlanRun, find_emitted
from optodrive.daemon.engine.queued_plans import QueuedPlans
from optodrive.daemon.engine.thermal_estimate import estimate_before_rest
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.group_state import LostStage
from optodrive.planning.display_model import DisplayModel

START_LEAD_S = 0.05
"""Minimum time from now, and from the end of the queue, to a plan's zero. Its first points must arrive in time."""


class Restart(NamedTuple):
    """Plans in their order as they go on after a pause, and the board time of its begin, which tells pauses apart."""

    plans: tuple[ActivePlan, ...]
    restarted: list[RestartedPlan]
    off_s: float | None


class QueuePause:
    """Pause of a queue. The queue's lock guards it, and only the loop's thread changes it.

    off_s: board time at which the light went off, None once the queue goes on
    """

    def __init__(self, plans: QueuedPlans, session: RemoteSession) -> None:
        self.off_s: float | None = None
        self._plans = plans
        self._session = session

    @property
    def is_held(self) -> bool:
        """Whether the light is paused. Any thread may read it."""
        return self._session.is_held

    @property
    def ends_in_s(self) -> float | None:
        """Time until the pause ends disarmed, s, or None if the light is not paused."""
        return self._session.pause_ends_in_s

    def require_no_pause(self) -> None:
        """Raise NotReadyError while the light is paused. An interruption by a lost stage is over in a moment."""
        self._session.connection.receive()
        if self.is_held and not self._session.is_interrupted:
            raise NotReadyError("the light is paused, and a streamed frame shows the present; resume first")

    def begin(self, off_s: float) -> None:
        """Let nothing start until the waiting plans are limited and proven again."""
        self.off_s = off_s

    def interrupt(self, off_s: float) -> None:
        """Let the plans that ran at the pause wait for the rest of their pulses. Drop the rest of a stream.

        off_s: board time at which the light went off
        """
        plans = self._plans
        with plans.lock:
            self.begin(off_s)
            ended: list[ActivePlan] = []
            while plans.running:
                run = plans.running.popleft()
                plans.accounts.count_progress(run)
                if self._session.lost is not None and self._counts_on(run, self._session.lost.stage):
                    ended += self._interrupt_by_loss(run, self._session.lost, off_s)
                    continue
                plan, record = run.plan, run.plan.record
                left = record.pulse_count - record.executed_count
                if record.streamed or not left:
                    record.dropped = left
                    is_left = left or plan.growth is not None
                    error = "the light was paused, and a stream shows the present" if is_left else None
                    plans.conclude(run, PlanStatus.SUPERSEDED if is_left else PlanStatus.DONE, error)
                    ended.append(plan)
                    continue
                plans.accounts.collect_executed(run)
                delay_s = record.delay_s
                plan.interrupt(off_s)
                plans.delay_all(delay_s)
                plans.waiting.appendleft(plan)
            if ended:
                plans.thermal.rewind(ended, plans.waiting)

    @staticmethod
    def _counts_on(run: PlanRun, stage: int) -> bool:
        """Return whether a running plan has points for a stage."""
        return len(run.plan.points.stages[stage]) > 0

    def _interrupt_by_loss(self, run: PlanRun, lost: LostStage, off_s: float) -> list[ActivePlan]:
        """Let the plan that ran last when a stage was lost wait for its rest, unless a newer streamed one waits.

        Its pulses that the lost board may have emitted count as executed. Time in the dark without a pulse is over.
        Return the plan if it has ended with that.
        """
        plans = self._plans
        plans.accounts.collect_executed(run)
        emitted = find_emitted(run, lost)
        plan, record = run.plan.reorder(emitted), run.plan.record
        first_row = int(np.count_nonzero(emitted))
        left_s = record.start_s + float(plan.planned.plan.start_s[first_row:].min(initial=inf))
        plan.interrupt(max(off_s, min(left_s, lost.dark_s)), first_row)
        plans.accounts.count_executed(plan)
        left = plan.rest_count
        if left and not plans.running and not any(each.record.streamed for each in plans.waiting):
            plans.waiting.appendleft(plan)
            return []
        record.dropped = left
        plans.end_waiting(
            plan, PlanStatus.SUPERSEDED if left else PlanStatus.DONE, "replaced by a newer plan" if left else None
        )
        return [plan]

    def end_if_idle(self) -> None:
        """Let the queue go on after a pause if nothing waits."""
        if self.off_s is not None and not self._plans.waiting and not self.is_held:
            self.off_s = None

    @property
    def can_restart(self) -> bool:
        """Whether waiting plans are to be limited and proven again now. Any thread may read it."""
        return self.off_s is not None and bool(self._plans.waiting) and not self.is_held

    def build_restart(
        self, display: DisplayModel, planning_time_s: float, on_progress: Callable[[], None]
    ) -> Restart | None:
        """Limit and prove the waiting plans again. Return None if none is to be restarted.

        planning_time_s: time that is reserved for this. Raise LocalProtocolError if one exceeds a cap.
        """
        with self._plans.lock:
            plans, off_s = tuple(self._plans.waiting), self.off_s
            if not self.can_restart:
                return None
        start_s = self._session.board_s() + START_LEAD_S + planning_time_s
        before = estimate_before_rest(plans[0], display.budget, on_progress)
        scales = self._session.scales
        restarted = restart_plans(display, scales, plans, before, start_s, START_LEAD_S, on_progress)
        return Restart(plans, restarted, off_s)

    def commit_restart(self, restart: Restart) -> bool:
        """Let the queue go on. Return False if the queue has changed meanwhile, or the light is paused again."""
        self._session.connection.receive()  # a STOP or a pause that has been answered is known from here on
        with self._plans.lock:
            if not self.can_restart or tuple(self._plans.waiting) != restart.plans or self.off_s != restart.off_s:
                return False
            delay_s = max(0.0, self._session.board_s() + START_LEAD_S - restart.restarted[0].start_s)
            for plan in restart.restarted:
                self._plans.accounts.totals["planned"] += plan.added_count
                plan.apply(delay_s)
            last = restart.restarted[-1]
            self._plans.thermal.set(last.after.with_delay(delay_s), last.end_s + delay_s)
            self.off_s = None
            return True
