"""Thermal estimate after all plans of the queue, and its changes at early ends, delays and restarts."""

from collections.abc import Callable, Sequence
from math import inf

from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.thermal_estimate import (
    EndedPlans,
    ThermalEstimate,
    estimate_before_rest,
    rewind_estimate,
)
from optodrive.daemon.engine.thermal_memory import SavedThermalState
from optodrive.link.service.remote_session import RemoteSession
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.limiter import commit_until

HOLD_MAX_S = 1.0
"""Longest time for which the board waits for points before it ends a plan."""


class QueueThermal:
    """The queue's thermal estimate. Not thread-safe: the queue's lock guards it.

    estimate: heat and budget after all plans, in board time; every change replaces it
    end_s: board time at which the last plan ends
    on_progress: called during long computations
    """

    def __init__(self, display: DisplayModel, session: RemoteSession, on_progress: Callable[[], None]) -> None:
        self.estimate = ThermalEstimate(*display.build_cold_state())
        self.end_s = 0.0
        self._budget = display.budget
        self._lease_s = display.config.lease_s
        self._session = session
        self._on_progress = on_progress

    def append(self, plan: ActivePlan) -> None:
        """Continue after a plan that was accepted as the last one."""
        record, planned = plan.record, plan.planned
        self.estimate = ThermalEstimate.from_plan(planned.heat, planned.budget, record.start_s)
        self.end_s = record.start_s + record.duration_s

    def set(self, estimate: ThermalEstimate, end_s: float | None = None) -> None:
        """Continue from another estimate. end_s: end of the last plan, that of the last pulse if None."""
        self.estimate = estimate
        self.end_s = estimate.budget.at_s if end_s is None else end_s

    def estimate_before(self, plan: ActivePlan) -> ThermalEstimate:
        """Return the estimate before a plan that waits, or before the rest of one that was interrupted."""
        return estimate_before_rest(plan, self._budget, self._on_progress)

    def go_back(self, plan: ActivePlan) -> None:
        """Continue from the estimate before a plan that will never be executed."""
        estimate = self.estimate_before(plan)
        # Pulses that were trimmed to nothing end later than the budget's time, and the heat is known from their end on.
        self.set(estimate, max(estimate.budget.at_s, plan.record.start_s))

    def forget(self, plan: ActivePlan, behind: Sequence[ActivePlan]) -> None:
        """Take back the heat of a plan that will never be executed. behind: the plans that wait behind it."""
        end_s = self.end_s
        self.go_back(plan)
        self._continue_with(behind, end_s)

    def rewind(
        self,
        ended: Sequence[ActivePlan],
        behind: Sequence[ActivePlan] = (),
        clock_shift_s: float = 0.0,
        notice_s: float = 0.0,
    ) -> None:
        """Count only the pulses that the plans that end early may have executed.

        behind: the plans that wait behind them
        clock_shift_s: by which the board's clock has jumped since they were queued
        notice_s: time until the link process renews the lease no more
        """
        end_s = self.end_s
        now_s = self._session.board_s() - clock_shift_s
        gate_off_s = max(now_s + notice_s + self._lease_s, self._session.dark_s)
        dark_s = now_s + self._session.round_trip_s  # the command that turns the gate off is on its way
        estimate = rewind_estimate(EndedPlans.from_plans(ended), gate_off_s, self._budget, self._on_progress, dark_s)
        self.set(estimate, max(gate_off_s, estimate.budget.at_s))
        self._continue_with(behind, end_s)

    def _continue_with(self, behind: Sequence[ActivePlan], end_s: float) -> None:
        """Let the plans that wait begin from the present estimate, each from that after the one before it.

        end_s: end of the last one
        """
        for plan in behind:
            start_s = plan.record.start_s
            heat, budget = self.estimate.shift_to_plan(start_s)
            plan.begin_from(heat, budget)
            after = commit_until(plan.planned.plan, inf, budget, self._budget, self._on_progress)
            self.set(ThermalEstimate.from_plan(plan.planned.heat, after, start_s), end_s)

    def delay(self, delay_s: float) -> None:
        """Shift all pulses, because a plan was late."""
        self.set(self.estimate.with_delay(delay_s), self.end_s + delay_s)

    # --- restarts -----------------------------------------------------------------------------------------------

    def shift_clock(self, delay_s: float) -> None:
        """Shift all pulses to the restarted clock of the board."""
        self.set(self.estimate.with_delay(delay_s))

    def build_saved_state(self, active: Sequence[ActivePlan], host_s: float) -> SavedThermalState:
        """Return the state from which a later planner process continues.

        active: plans that run, or the first that waits; host_s: present host time
        """
        ended = EndedPlans.from_plans(active) if active else None
        return SavedThermalState(host_s, self._session.board_s(), self.estimate, ended)

    def build_saved_key(self, active: Sequence[ActivePlan]) -> object:
        """Return a value that changes whenever build_saved_state() would return another state.

        It leaves out that a plan has ended while the next one runs: the state before both counts the same pulses.
        """
        records = [plan.record for plan in active[-1:]]
        return id(self.estimate), tuple((record.plan_id, record.dropped, record.start_s) for record in records)

    def restore(self, saved: SavedThermalState, host_s: float) -> None:
        """Continue from the state of an earlier planner, whose plans the link process has ended.

        Every pulse that may have started before now counts, up to the longest time late that the board permits. The
        board's clock may have restarted meanwhile.
        """
        board_s = self._session.board_s()
        expected_s = saved.board_s + host_s - saved.host_s
        gate_off_s = expected_s + self._lease_s
        estimate = saved.estimate
        if saved.ended is not None:
            estimate = rewind_estimate(saved.ended, gate_off_s, self._budget, self._on_progress, expected_s)
        self.set(estimate.with_delay(board_s - expected_s + HOLD_MAX_S))
