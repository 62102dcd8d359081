"""The state of the queue of plans as one value, and its transitions.

Theory of operation

Problem. A plan is computed by another thread, from a heat and a budget that lie in the future: those after all plans
accepted so far. Until it is accepted that future may change: a plan ends late, fails, is cancelled or replaced, the
board restarts, the light is paused. A plan from a wrong past must never reach the board: its pulses would be too
strong.

The value. `QueueState` is frozen, and so is each plan in it. A transition is a method without effects that returns the
state after it; plans that left the queue with it stand in `ended`. The one thread that owns the session applies
transitions (`plan_queue.py:PlanQueue`); any other reads a state as a whole, without a lock.

Invariants. `thermal` is the estimate after everything that runs or waits, and is another object after each change. A
snapshot holds that object; a plan is accepted only if it is still the same one, so one comparison finds every change,
and the planner plans again otherwise. Heat is taken back only by computing it again from executed pulses, also for the
plans that wait. Plans run in the order of acceptance. What has left for the board is never withdrawn, except by turning
the gate off, which ends all running plans. Every pulse is counted exactly once: as executed, dropped, or left in the
plan that waits for its rest.

Widths. A pulse's width is that for the heat at its start. A plan may start later than it was planned for only by a time
in which nothing cools noticeably; all plans behind it are then delayed by as much. After anything else that changes the
heat before it, a plan that waits is planned anew (`off_s`).

Interruptions. In a pause the board drops its queue; what was not executed becomes the rest of the same plan, which
waits at the front and is planned anew for the time at which the light returns (decision 37). A stream is dropped, as it
shows the present. Points that would be late, and the loss of a stage where the others go on, interrupt as a pause does;
of a stream the rest is then drawn, unless a newer frame waits already. Nobody knows what a lost board emitted: what it
was sent for the time before it was dark for certain counts, and is not repeated.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray
from optodrive.daemon.engine.active_plan import ActivePlan, PlanRows, ThermalEstimate
from optodrive.daemon.engine.plan_rest import (
    EndedPlans,
    Restart,
    estimate_before_rest,
    rewind_estimate,
)
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.session.group_state import LostStage
from optodrive.link.session.staged_job import StagedJob
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import commit_until

MIN_DELAY_S = 1e-5
"""A plan that is late by more than this delays those behind it."""
REPLACED = "replaced by a newer plan"
PAUSED = "the light was paused, and a stream shows the present"


class PlanRun(NamedTuple):
    """Running plan with its job."""

    plan: ActivePlan
    job: StagedJob


class PlanEnd(NamedTuple):
    """Plan that left the queue, with its final status and the reason for people."""

    plan: ActivePlan
    status: PlanStatus
    error: str | None


class LightEnd(NamedTuple):
    """Board times at which light that is turned off now is off: dark_s probably, gate_off_s for certain."""

    dark_s: float
    gate_off_s: float


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


@dataclass(frozen=True, eq=False)
class QueueState:
    """State of the queue at one moment.

    budget, on_progress: of the display, and called during long computations; the same in all states of a queue
    thermal: after all plans, in board time; end_s: board time at which the last one ends
    running: with their jobs, each continued by the next; waiting: in their order
    off_s: board time at which the light went off, None unless the waiting plans are to be planned anew first
    last: plan that ended last if it was streamed; is_unfinished: whether its rest is due, as no newer plan came
    ended: plans that left the queue with the last transition
    """

    budget: Budget
    on_progress: Callable[[], None]
    thermal: ThermalEstimate
    end_s: float = 0.0
    running: tuple[PlanRun, ...] = ()
    waiting: tuple[ActivePlan, ...] = ()
    off_s: float | None = None
    last: ActivePlan | None = None
    is_unfinished: bool = False
    ended: tuple[PlanEnd, ...] = ()

    # --- what it says -------------------------------------------------------------------------------------------

    @property
    def is_busy(self) -> bool:
        """Whether a plan runs or waits."""
        return bool(self.running or self.waiting)

    @property
    def plans(self) -> tuple[ActivePlan, ...]:
        """Return all plans, in the order of their light."""
        return (*(run.plan for run in self.running), *self.waiting)

    @property
    def active(self) -> tuple[ActivePlan, ...]:
        """Return the running plans, or the first that waits."""
        return tuple(run.plan for run in self.running) or self.waiting[:1]

    @property
    def newest(self) -> ActivePlan | None:
        """The streamed plan that was accepted last, None if another plan was, or none since the last restart."""
        if not self.is_busy:
            return self.last
        newest = self.plans[-1]
        return newest if newest.record.streamed else None

    @property
    def replaceable(self) -> ActivePlan | None:
        """The running streamed plan that a newer one may truncate, None without one."""
        plan = self.newest
        return plan if self.running and not self.waiting and plan is not None and not plan.record.dropped else None

    @property
    def growing(self) -> ActivePlan | None:
        """The plan accepted last if it is still to grow, and runs, waits, or has ended without its rest."""
        plan = self.newest
        if plan is None or plan.growth is None or not (self.is_busy or self.is_unfinished):
            return None
        return None if plan.record.dropped else plan

    @property
    def must_preempt(self) -> bool:
        """Whether a newer streamed plan must preempt others first."""
        return bool(self.waiting) or any(not run.plan.record.streamed for run in self.running)

    # --- accepting plans ----------------------------------------------------------------------------------------

    def accept(self, plan: ActivePlan) -> "QueueState":
        """Let a plan wait behind all others."""
        plan = plan.become(PlanStatus.QUEUED)
        return self._count(plan.after, plan.record.start_s + plan.record.duration_s, waiting=(*self.waiting, plan))

    def replace_from(self, row: int, run: PlanRun) -> "QueueState":
        """Continue the last running plan, of which `row` rows are kept, with another."""
        plan = run.plan.become(PlanStatus.RUNNING)
        end_s = plan.record.start_s + plan.record.duration_s
        running = (*self._drop_from(row), PlanRun(plan, run.job))
        return self._count(plan.after, end_s, running=running)

    def truncate(self, row: int, after: ThermalEstimate, end_s: float) -> "QueueState":
        """End the last running plan behind its first `row` rows.

        after: heat and budget then; end_s: board time
        """
        return self._count(after, end_s, running=self._drop_from(row))

    def _drop_from(self, row: int) -> tuple[PlanRun, ...]:
        *before, (plan, job) = self.running
        return (*before, PlanRun(plan.note(dropped=plan.record.pulse_count - row), job))

    def end_behind(self, row: int, plan: ActivePlan) -> "QueueState":
        """End the last running plan behind its first `row` rows for a plan without pulses, which ends with that."""
        state = self.truncate(row, plan.after, plan.record.start_s + plan.record.duration_s)
        return state._end([plan.become(PlanStatus.RUNNING)], PlanStatus.DONE, None)

    def extend(self, rows: PlanRows) -> "QueueState":
        """Let the plan accepted last go on with the rest of its rows."""
        plan = self.plans[-1]
        # The rest was planned from the heat for which the first part was made, which may be more.
        plan = plan.rebase(plan.record.start_s, plan.before, rows)
        end_s = plan.record.start_s + plan.record.duration_s
        if self.waiting:
            return self._count(plan.after, end_s, waiting=(*self.waiting[:-1], plan))
        return self._count(plan.after, end_s, running=(*self.running[:-1], PlanRun(plan, self.running[-1].job)))

    def withdraw(self) -> "QueueState":
        """Withdraw all waiting plans for a newer one. Pulses that never start leave no heat."""
        plans = self.waiting
        if not plans:
            return self
        state = replace(self, waiting=(), off_s=None)._go_back(plans[0])
        plans = tuple(plan.note(dropped=plan.rest_count) for plan in plans)
        return state._end(plans, PlanStatus.SUPERSEDED, REPLACED)

    # --- running plans ------------------------------------------------------------------------------------------

    def begin(self, job: StagedJob | None) -> "QueueState":
        """Begin the first waiting plan. job: None if nothing is left of it, which ends it."""
        plan, *waiting = self.waiting
        state = replace(self, waiting=tuple(waiting))
        if job is None:
            return state._end([plan], PlanStatus.DONE, None)
        return replace(state, running=(*self.running, PlanRun(plan.become(PlanStatus.RUNNING), job)))

    def update_runs(self, runs: Sequence[PlanRun]) -> "QueueState":
        """Take over the reports on the running plans."""
        is_news = any(new is not old for new, old in zip(runs, self.running, strict=True))
        return replace(self, running=tuple(runs)) if is_news else self

    def finish(self, light: LightEnd) -> "QueueState":
        """End the first running plan, all of whose points are executed. A late end delays all plans behind it."""
        plan = self.running[0].plan
        is_partial = bool(plan.record.dropped) or plan.growth is not None
        status = PlanStatus.SUPERSEDED if is_partial else PlanStatus.DONE
        state = replace(self, running=self.running[1:])._end([plan], status, None).delay(plan.record.delay_s)
        if plan.is_cut_short and not state.running:  # a pause has begun, and its last report is here first
            state = state._rewind([plan], light)
        return replace(state, is_unfinished=plan.growth is not None and not state.is_busy)

    def end_running(self, status: PlanStatus, error: str | None, light: LightEnd) -> "QueueState":
        """End all running plans. Their reports are collected. Those that wait begin from the heat that is left."""
        ended = [run.plan for run in self.running]
        state = replace(self, running=())._end(ended, status, error)
        return state.delay(max(plan.record.delay_s for plan in ended))._rewind(ended, light) if ended else self

    def end_all(self, status: PlanStatus, error: str, light: LightEnd) -> "QueueState":
        """End all running and waiting plans."""
        state = replace(self, waiting=()).end_running(status, error, light)
        if not self.running and self.waiting:
            state = state._take_back(self.waiting[0], light, 0, self.end_s)
        return state._end(self.waiting, status, error)

    def preempt(self, sent: int, light: LightEnd) -> "QueueState":
        """End the running plan for a newer one. sent: number of its pulses that have left since it began or went on."""
        (plan, job), *others = self.running
        plan = plan.note(dropped=plan.rest_count - sent)
        return replace(self, running=(PlanRun(plan, job), *others)).end_running(PlanStatus.SUPERSEDED, REPLACED, light)

    def cancel(self, plan_id: str, error: str, light: LightEnd) -> "QueueState":
        """Remove a waiting plan, or end the running ones if it is among them. Others have no such plan."""
        ids = [plan.plan_id for plan in self.waiting]
        if plan_id in ids:
            at = ids.index(plan_id)
            plan, end_s = self.waiting[at], self.end_s
            state = replace(self, waiting=self.waiting[:at] + self.waiting[at + 1 :])
            state = state._take_back(plan, light, at, end_s)
            return state._end([plan], PlanStatus.CANCELLED, error or "removed from the queue")
        if any(run.plan.plan_id == plan_id for run in self.running):
            return self.end_running(PlanStatus.CANCELLED, error or "cancelled while running", light)
        return self

    # --- pauses and lost stages ---------------------------------------------------------------------------------

    def hold(self, off_s: float | None) -> "QueueState":
        """Let nothing begin until the waiting plans are made again.

        off_s: board time from which that counts, None to let plans begin again
        """
        return replace(self, off_s=off_s)

    def interrupt(self, off_s: float, reason: str, lost: LostStage | None, light: LightEnd) -> "QueueState":
        """Let the plans that ran wait for the rest of their pulses. Their reports are collected.

        off_s: board time at which the light went off; reason: for people, '' for a pause; lost: the stage that was lost
        """
        state, ended = replace(self, off_s=off_s), []
        while state.running:
            run, state = state.running[0], replace(state, running=state.running[1:])
            plan = run.plan
            if lost is not None and len(plan.points.stages[lost.stage]):
                plan = _interrupt_by_loss(run, lost, off_s)
            is_followed = bool(state.running) or any(each.record.streamed for each in state.waiting)
            # The next refresh of a page knows better what is due now.
            is_over = is_followed or plan.record.refreshes if reason else plan.record.streamed
            left = plan.left_count
            if is_over or not left:
                is_partial = left or plan.growth is not None
                plan = plan.note(dropped=left)
                status = PlanStatus.SUPERSEDED if is_partial else PlanStatus.DONE
                state = state._end([plan], status, (reason or PAUSED) if is_partial else None)
                ended.append(plan)
            elif plan.is_interrupted:
                state = replace(state, waiting=(plan, *state.waiting))
            else:
                state = state.delay(plan.record.delay_s)
                state = replace(state, waiting=(plan.interrupt(off_s), *state.waiting))
        return state._rewind(ended, light) if ended else state

    def resume(self, restart: Restart, delay_s: float) -> "QueueState":
        """Go on with the waiting plans as they were made again, delay_s later than they were limited for."""
        waiting = tuple(plan.delay_points(delay_s) for plan in restart.restarted)
        return self._count(restart.after.shift(delay_s), restart.end_s + delay_s, waiting=waiting, off_s=None)

    # --- heat and time ------------------------------------------------------------------------------------------

    def delay(self, delay_s: float) -> "QueueState":
        """Shift all plans, and the heat after them, because one was late by more than MIN_DELAY_S."""
        if delay_s <= MIN_DELAY_S:
            return self
        runs = ((run.plan.rebase(run.plan.record.start_s + delay_s), run.job) for run in self.running)
        waiting = tuple(plan.rebase(plan.record.start_s + delay_s) for plan in self.waiting)
        thermal, end_s = self.thermal.shift(delay_s), self.end_s + delay_s
        return self._count(thermal, end_s, running=tuple(PlanRun(*run) for run in runs), waiting=waiting)

    def shift_clock(self, delay_s: float) -> "QueueState":
        """Shift heat and budget to the restarted clock of the board."""
        return self.know(self.thermal.shift(delay_s)).forget_stream()

    def know(self, thermal: ThermalEstimate) -> "QueueState":
        """Continue from another estimate, as of an earlier planner or daemon."""
        return self._count(thermal, thermal.budget.at_s)

    def give_up_rest(self) -> "QueueState":
        """Give up the rest of a plan that has ended without it."""
        return replace(self, is_unfinished=False)

    def forget_stream(self) -> "QueueState":
        """Begin a new refresh cycle, because the clock has jumped or accepted plans were not drawn."""
        return replace(self, last=None, is_unfinished=False)

    def estimate_end(self, light: LightEnd, hold_s: float) -> ThermalEstimate:
        """Return the estimate after the end of all plans by the end of this process.

        Each pulse that may have started by then counts, up to hold_s late.
        """
        active = self.active
        if not active:
            return self.thermal
        delay_s = hold_s + max(plan.record.delay_s for plan in active)
        return replace(self, waiting=())._rewind(active, light).thermal.shift(delay_s)

    def _count(self, thermal: ThermalEstimate, end_s: float, **changes: Any) -> "QueueState":
        """Return the state with another estimate after all plans. The rest of an ended plan is then no longer due."""
        return replace(self, thermal=thermal, end_s=end_s, is_unfinished=False, **changes)

    def _end(self, plans: Sequence[ActivePlan], status: PlanStatus, error: str | None) -> "QueueState":
        """Note plans that were removed as ended."""
        ended = tuple(PlanEnd(plan, status, error) for plan in plans)
        last = self.last if not plans else plans[-1] if plans[-1].record.streamed else None
        return replace(self, ended=self.ended + ended, last=last)

    def _go_back(self, plan: ActivePlan) -> "QueueState":
        """Continue from the estimate before a plan that was removed and will never be executed."""
        estimate = estimate_before_rest(plan, self.budget, self.on_progress)
        # Pulses that were trimmed to nothing end later than the budget's time, and the heat is known from their end on.
        return self._count(estimate, max(estimate.budget.at_s, plan.record.start_s))

    def _take_back(self, plan: ActivePlan, light: LightEnd, at: int, end_s: float) -> "QueueState":
        """Continue without a plan that waited, behind which those from index `at` on wait."""
        if plan.is_interrupted:
            return self._rewind([plan], light, at)
        return self._go_back(plan)._continue_from(at, end_s, light)

    def _rewind(self, ended: Sequence[ActivePlan], light: LightEnd, at: int = 0) -> "QueueState":
        """Count only the pulses that plans which were removed may have executed.

        at: index of the first waiting plan behind them
        """
        plans, (dark_s, gate_off_s) = EndedPlans.from_plans(ended), light
        estimate = rewind_estimate(plans, gate_off_s, self.budget, self.on_progress, dark_s)
        return self._count(estimate, max(gate_off_s, estimate.budget.at_s))._continue_from(at, self.end_s, light)

    def _continue_from(self, at: int, end_s: float, light: LightEnd) -> "QueueState":
        """Let the plans that wait begin from the present estimate, each from that after the one before it.

        They are planned anew before they begin. at: index of the first one; end_s: end of the last one
        """
        waiting, thermal = list(self.waiting), self.thermal
        for number, plan in enumerate(waiting[at:], at):
            start_s = plan.record.start_s
            before = thermal.shift(-start_s)
            plan = waiting[number] = plan.rebase(start_s, before)
            budget = commit_until(plan.planned.plan, inf, before.budget, self.budget, self.on_progress)
            thermal = ThermalEstimate(plan.planned.heat, budget).shift(start_s)
        if not waiting[at:]:
            return self
        off_s = light.dark_s if self.off_s is None else self.off_s
        return self._count(thermal, end_s, waiting=tuple(waiting), off_s=off_s)


def _interrupt_by_loss(run: PlanRun, lost: LostStage, off_s: float) -> ActivePlan:
    """Return the rest of a plan after the loss of a stage.

    Its pulses that the lost board may have emitted count as executed. Time in the dark without a pulse is over.
    """
    emitted = find_emitted(run, lost)
    plan = run.plan.reorder(emitted)
    first_row, start_s = int(np.count_nonzero(emitted)), plan.planned.plan.start_s
    left_s = plan.record.start_s + float(start_s[first_row:].min(initial=inf))
    plan = plan.interrupt(max(off_s, min(left_s, lost.dark_s)), first_row)
    # Also those behind a gap that the lost board has left.
    return plan.note(executed_count=plan.executed_before)
