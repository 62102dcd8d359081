"""Streamed plans of the queue.

A source that sends frames wants the newest shown, not a queue of the past (decision 16). Points of a streamed plan
leave only `lead_s` before they are due; a newer plan cuts the running one at the first point that has not left
(`build_cut_snapshot`) and is spliced behind it, one job for the board. If all points have left it follows them, with
a pause if it comes early, as long as the light of the last one is not about to end (decision 16). Its first point is
held back if yet another plan is expected before it must leave, and always for a refresh of a standing page: that one
then withdraws the plan as a whole and begins where it would have begun. The lead is longer without real-time priority,
because a stall of the host longer than the lead is an underrun (decision 16). A splice that comes too late is refused
by link, and the plan is made again; after two such plans `truncate` cuts the running one at once, and the third begins
behind it without a deadline.

A plan may grow: its rest is planned when the points behind it must leave, unless a newer plan came (`plan_making.py`).
If that is too late, because the computer stalled, the rest becomes a frame of its own behind it.
"""

from math import inf

from optodrive.daemon.engine.active_plan import ActivePlan, RefreshCycle
from optodrive.daemon.engine.plan_making import ExtendedPlan, PlanningSnapshot, build_cut_snapshot, continue_cycle
from optodrive.daemon.engine.queued_plans import PlanRun, QueuedPlans
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.protocol.stage_points import PointCut
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.session import SPLICE_LEAD_S
from optodrive.planning.display_model import DisplayModel

STREAM_START_LEAD_S = 0.02
"""Time from the end of a frame's planning to its light if the beam is free."""
STREAM_RESTART_S = 0.01
"""Time from the end of a job to the light of the next one, so that the board's report and START pass meanwhile."""
SHARED_STREAM_LEAD_S = 0.04
"""Least lead of a stream if the link process has no real-time scheduling."""
APPEND_LEAD_S = SPLICE_LEAD_S + 0.002
"""Least time between a plan and the end of the light that it follows if all of that has left."""
GROWTH_MARGIN_S = 0.01
"""Time reserved for the loop and the hand-over of a plan's rest, besides its planning."""


class QueueStream:
    """Replacement of unsent pulses by a streamed plan. Any thread may read lead_s and must_preempt."""

    def __init__(self, plans: QueuedPlans, display: DisplayModel, session: RemoteSession) -> None:
        self._plans = plans
        self._display = display
        self._session = session
        self._last: ActivePlan | None = None
        self._unfinished: tuple[ActivePlan, ThermalEstimate] | None = None

    @property
    def lead_s(self) -> float:
        """Time for which points of a streamed plan are sent ahead. A longer stall of the host causes an underrun."""
        lead_s = self._display.config.stream_lead_s
        # A stall longer than the lead is an underrun, and stalls are longer without real-time priority.
        return lead_s if self._session.is_realtime else max(lead_s, SHARED_STREAM_LEAD_S)

    def find_running(self) -> ActivePlan | None:
        """Return the running streamed plan that a newer one may truncate, None without one."""
        if self._plans.waiting or not self._plans.running:
            return None
        plan = self._plans.running[-1].plan
        return plan if plan.record.streamed and not plan.record.dropped else None

    def build_cut_snapshot(
        self, running: ActivePlan, thermal: ThermalEstimate, planning_time_s: float
    ) -> PlanningSnapshot | None:
        """Build the snapshot of a plan that truncates a running one, None if that is not possible any more."""
        planned_s = self._session.board_s() + planning_time_s
        budget, tick_s = self._display.budget, self._session.tick_s
        # Several boards end each job together: nothing follows what has left.
        min_end_s = planned_s + APPEND_LEAD_S if len(self._session.scales) == 1 else inf
        return build_cut_snapshot(
            running,
            thermal,
            planned_s + self.lead_s,
            budget,
            tick_s,
            running.holds_first,
            min_end_s,
            begin_s=planned_s + STREAM_START_LEAD_S,
        )

    def splice(self, plan: ActivePlan, predecessor: ActivePlan, cut: PointCut) -> bool:
        """Continue the points of a running plan with those of a new one. Return False if the cut has been sent."""
        # It has ended, or another has been spliced behind it, since the snapshot.
        if not self._plans.running or self._plans.running[-1].plan is not predecessor:
            return False
        zero_s, ahead_s, dropped = plan.record.start_s, self.lead_s, predecessor.record.pulse_count - cut.row
        if not plan.record.pulse_count:  # it only ends what was shown: a job without points would be the last one
            done = not dropped or self._session.truncate(cut.kept_points)
        else:
            due_in_s = zero_s - ahead_s - self._session.board_s()
            interval_s = plan.record.arrived_s - predecessor.record.arrived_s  # the next one may come after as much
            plan.holds_first = plan.record.refreshes or due_in_s > interval_s
            job = self._session.splice(
                plan.points, cut.kept_points, zero_s, plan.epoch, ahead_s, plan.crc, plan.holds_first
            )
            done = job is not None
            if job is not None:
                self._plans.running.append(PlanRun(plan, job))
        if done:
            predecessor.record.dropped = dropped
        return done

    @staticmethod
    def follow_withdrawn(plan: ActivePlan, snapshot: PlanningSnapshot) -> None:
        """Count the light of a refresh from the arrival of the fingers that a refresh withdrawn as a whole followed."""
        withdrawn = snapshot.predecessor
        if plan.record.refreshes and withdrawn is not None and snapshot.cut is not None and not snapshot.cut.row:
            plan.record.arrived_s = min(plan.record.arrived_s, withdrawn.record.arrived_s)

    @property
    def must_preempt(self) -> bool:
        """Whether a newer streamed plan must preempt others first."""
        with self._plans.lock:
            return bool(self._plans.waiting) or any(not run.plan.record.streamed for run in self._plans.running)

    def preempt(self) -> None:
        """Supersede the waiting plans, and end a running plan that is not streamed, for a newer plan."""
        with self._plans.lock:
            if self._plans.waiting:
                # To before the first one: what never starts leaves no heat.
                self._plans.thermal.go_back(self._plans.waiting[0])
            while self._plans.waiting:
                plan = self._plans.waiting.popleft()
                plan.record.dropped = plan.rest_count
                self._plans.end_waiting(plan, PlanStatus.SUPERSEDED, "replaced by a newer plan")
            if self._plans.running and not self._plans.running[-1].plan.record.streamed and not self._session.is_held:
                plan, job = self._plans.running[0]
                plan.record.dropped = plan.record.pulse_count - job.sent_count
                self._session.flush()
                self._plans.end_running(PlanStatus.SUPERSEDED, "replaced by a newer plan")

    def truncate(self) -> None:
        """Truncate the running streamed plan at the first pulse not yet due to be sent.

        The next plan then starts after it, without a splice deadline.
        """
        with self._plans.lock:
            last = self.find_running()
            if last is None:
                return
            snapshot = self.build_cut_snapshot(last, self._plans.thermal.estimate, planning_time_s=0.0)
            if snapshot is None or snapshot.cut is None or not self._session.truncate(snapshot.cut.kept_points):
                return
            last.record.dropped = last.record.pulse_count - snapshot.cut.row
            estimate = ThermalEstimate.from_plan(snapshot.heat, snapshot.budget, snapshot.start_s)
            self._plans.thermal.set(estimate, snapshot.start_s)

    # --- growing plans ------------------------------------------------------------------------------------------

    def compute_due_in_s(self, planning_time_s: float) -> float:
        """Return the time until the rest of the running plan must be planned, infinity if it has none.

        planning_time_s: time that this takes
        """
        if self._find_unfinished() is not None:
            return 0.0
        plan = self.find_running()
        if plan is None or plan.growth is None:
            return inf
        rows = plan.planned.plan
        last_point_s = float(rows.start_s[-2] + rows.width_s[-2]) if len(rows) > 1 else 0.0
        due_s = plan.record.start_s + plan.zero_s + last_point_s - self.lead_s - planning_time_s - GROWTH_MARGIN_S
        return due_s - self._session.board_s()

    def find_growing(self) -> ActivePlan | None:
        """Return the plan accepted last if it is still to grow, and runs, waits, or has ended without its rest."""
        with self._plans.lock:
            if self._plans.waiting:
                plan = self._plans.waiting[-1]
            elif self._plans.running:
                plan = self._plans.running[-1].plan
            else:
                return self._find_unfinished()
            return plan if plan.growth is not None and not plan.record.dropped else None

    def _find_unfinished(self) -> ActivePlan | None:
        """Return the plan that has ended without its rest if nothing has come since."""
        with self._plans.lock:
            if self._unfinished is None or self._plans.is_busy:
                return None
            plan, thermal = self._unfinished
            return plan if thermal is self._plans.thermal.estimate else None

    def keep_unfinished(self, plan: ActivePlan) -> None:
        """Keep a plan that has ended although no newer one came before its rest was planned."""
        if plan.growth is not None and not self._plans.is_busy:
            self._unfinished = plan, self._plans.thermal.estimate

    def forget_unfinished(self) -> None:
        """Give up the plan that has ended without its rest."""
        self._unfinished = None

    def extend(self, plan: ActivePlan, grown: ExtendedPlan) -> bool:
        """Append the rest of a plan to it. Return False, unchanged, if it is too late or a newer plan came."""
        self._session.connection.receive()
        with self._plans.lock:
            if not self._plans.is_busy or self.find_growing() is not plan:
                return False
            if not self._plans.waiting:
                job = self._plans.running[-1].job
                # Link first: if it refuses, nothing here has changed.
                if not self._session.extend(job, grown.added, plan.epoch, grown.added_crc):
                    return False
            self._plans.accounts.totals["planned"] += len(grown.planned.plan) - plan.record.pulse_count
            plan.replace_rows(grown.planned, grown.points, grown.crc, grown.summary_json)
            plan.predict_heat()  # the rest was planned from the heat for which the first part was made
            self._plans.thermal.append(plan)
            return True

    def withdraw(self) -> None:
        """Withdraw the points of the newest plan that have not left, before its rest becomes a frame of its own."""
        if self._plans.waiting:
            self.preempt()
        else:
            self.truncate()

    # --- refresh cycle ------------------------------------------------------------------------------------------

    def record_accepted(self, plan: ActivePlan) -> None:
        """Record the plan that was accepted last. One that is not streamed ends the refresh cycle."""
        self._last = plan if plan.record.streamed else None

    def forget_cycle(self) -> None:
        """Begin a new refresh cycle, because the board's clock has jumped or accepted plans were not drawn."""
        self._last = None

    def find_cycle(self) -> RefreshCycle | None:
        """Return the refresh cycle after the plan accepted last, None if another plan has come in between."""
        last = self._last
        return None if last is None else continue_cycle(last, last.record.pulse_count - last.record.dropped)
