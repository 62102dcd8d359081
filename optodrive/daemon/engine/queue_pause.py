"""Pause of the queue: keeps plans from starting until they are limited and proven again.

The board drops its queue; what was not executed becomes the rest of the same plan, which waits at the front and
is limited again for the time at which the light returns (decision 37). A stream is dropped, as it shows the present.
The loss of a stage, where the others go on, interrupts as a pause does. Nobody knows what the lost board emitted: what
it was sent for the time before it was dark for certain counts, and is not repeated. What is left is planned anew, also
that of a stream, unless a newer frame waits already (decision 49).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import NotReadyError
from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame, Train
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.queued_plans import PlanRun, QueuedPlans, find_emitted
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate, estimate_before_rest
from optodrive.daemon.responses.plan import PlanStatus
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.proven_points import prove
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.session.group_state import LostStage
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.rest import delay_rest, limit_rest, replace_rest
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.plan_summary import summarize_plan
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.planning.summary_schema import PlanSummary

DURATION_MIN_S = 1e-3
"""Duration of the rest of a frame whose time is over."""
CYCLE_ROUNDING = 0.01
"""Largest share of a train's cycle by which rounding to microseconds moves a pulse."""


def build_rest_sequence(planned: PlannedSequence, first_row: int, origin_s: float) -> tuple[FrameSequence, IntArray]:
    """Return the requests of the rows from first_row on, and the source of each in the plan's sequence.

    A frame keeps the pixels that were not drawn, a train the cycles of which nothing was; both keep their rhythm.
    origin_s: time of the plan from which the rest counts
    """
    sequence = planned.sequence
    if not first_row:
        return sequence, np.arange(len(sequence.frames) + len(sequence.trains))
    frames: dict[int, TactileFrame] = {}
    trains: dict[int, Train] = {}
    begin_s = 0.0
    for source in np.unique(planned.plan.source[first_row:]).tolist():
        if source < len(sequence.frames):
            frame = _build_frame(planned, source, first_row, origin_s)
            if frame is not None:
                begin_s = max(begin_s, frame.show_at_s)
                frames[source] = replace(frame, show_at_s=begin_s)
        else:
            train = _build_train(planned, source, first_row, origin_s)
            if train is not None:
                trains[source] = train
    sources = np.array([*frames, *trains], dtype=np.int64)
    return FrameSequence(tuple(frames.values()), tuple(trains.values())), sources


def _build_frame(planned: PlannedSequence, source: int, first_row: int, origin_s: float) -> TactileFrame | None:
    plan, frame = planned.plan, planned.sequence.frames[source]
    rows = np.flatnonzero(plan.source == source)
    done, left = rows[rows < first_row], rows[rows >= first_row]
    show_at_s = max(0.0, float(plan.start_s[left].min()) - origin_s)
    if not len(done):
        return replace(frame, show_at_s=show_at_s)
    pixels = plan.pixel[left[np.isfinite(plan.target_m[left])]]  # sub-pulses alone raise no pixel to its height
    if not len(pixels):
        return None
    target_m = np.zeros_like(frame.target_m)
    target_m[pixels] = frame.target_m[pixels]
    shown_s = max(0.0, origin_s - float(plan.start_s[done].min()))
    duration_s = max(DURATION_MIN_S, frame.duration_s - shown_s)
    return replace(frame, show_at_s=show_at_s, duration_s=duration_s, target_m=target_m)


def _build_train(planned: PlannedSequence, source: int, first_row: int, origin_s: float) -> Train | None:
    plan, train = planned.plan, planned.sequence.trains[source - len(planned.sequence.frames)]
    period_s = train.pulse_width_s + train.gap_s if isinstance(train, PulseTrain) else train.period_s
    rows = np.flatnonzero(plan.source == source)
    requested_s = plan.requested_start_s[rows] - planned.lead_in_s - train.start_s
    cycle = np.floor(requested_s / period_s + CYCLE_ROUNDING).astype(np.int64)
    is_left = (rows >= first_row) & (cycle > cycle[rows < first_row].max(initial=-1))
    if not is_left.any():
        return None
    start_s = max(0.0, float(plan.start_s[rows[is_left]].min()) - origin_s)
    return replace(train, start_s=start_s, duration_s=train.duration_s - float(cycle[is_left].min()) * period_s)


@dataclass(frozen=True, eq=False)
class RestartedPlan:
    """Replacements for the parts of a plan that goes on.

    start_s: board time at which its points begin; after: state after it, in board time; end_s: of its last pulse
    planned: the whole plan; its rows from plan.first_row on are limited and timed anew
    zero_s: begin of the points on the time line of `planned`
    """

    plan: ActivePlan
    start_s: float
    zero_s: float
    planned: PlannedSequence
    points: StagePoints
    crc: int
    summary_json: bytes
    before: ThermalEstimate
    after: ThermalEstimate
    end_s: float

    @property
    def added_count(self) -> int:
        """Number of pulses that the plan has more than before, negative for less."""
        return len(self.planned.plan) - len(self.plan.planned.plan)

    def apply(self, delay_s: float) -> None:
        """Replace the parts of the plan, which begins delay_s later than it was limited for: never warmer."""
        plan, record, planned, zero_s = self.plan, self.plan.record, self.planned, self.zero_s
        if plan.first_row:
            zero_s += delay_s
            planned = replace(planned, plan=delay_rest(planned.plan, plan.first_row, delay_s))
        else:  # nothing was executed: the plan begins anew
            record.start_s = self.start_s + delay_s
            plan.heat_before, plan.budget_before = self.before.shift_to_plan(self.start_s)
        plan.replace_rows(planned, self.points, self.crc, self.summary_json)
        plan.is_interrupted = False
        plan.zero_s = plan.origin_s = zero_s
        plan.initial_pixels = None


def restart_plans(
    display: DisplayModel,
    scales: Sequence[WireScale],
    plans: Sequence[ActivePlan],
    before: ThermalEstimate,
    start_s: float,
    gap_s: float,
    on_progress: Callable[[], None],
) -> list[RestartedPlan]:
    """Limit and prove plans that follow each other.

    before: state before the first; start_s: board time at which the first begins; gap_s: between two plans
    Raise LocalProtocolError if the bytes of one exceed a cap, and what on_progress raises.
    """
    restarted = []
    for plan in plans:
        start_s = max(start_s, before.budget.at_s)
        restarted.append(_restart(display, scales, plan, before, start_s, on_progress))
        before, start_s = restarted[-1].after, restarted[-1].end_s + gap_s
    return restarted


def _restart(
    display: DisplayModel,
    scales: Sequence[WireScale],
    plan: ActivePlan,
    before: ThermalEstimate,
    start_s: float,
    on_progress: Callable[[], None],
) -> RestartedPlan:
    first, planned = plan.first_row, plan.planned
    if plan.growth is not None:
        plan.growth.on_progress = lambda _: on_progress()
        planned = plan.growth.plan_until()
    heat, budget = before.shift_to_plan(start_s)
    is_made_for_all = display.draws.all() or (first and _is_made_for(display, plan))
    if is_made_for_all and (first or planned.delays):  # under "delay" its pulses have the times that caps allowed them
        rest, budget_after = limit_rest(planned.plan, first, -_find_origin_s(plan), budget, display.budget, on_progress)
    else:
        rest, budget_after = _plan_anew(display, plan, heat, budget, on_progress)
    points = StagePoints.from_plan(rest, scales, display.draws)
    on_progress()
    proven = prove(rest, points, scales, budget, display.budget, on_progress)
    heat_after = heat.copy()
    peaks = heat_after.apply_pulses(rest.pixel, rest.start_s, rest.width_s, rest.power_w, on_progress)
    after = ThermalEstimate.from_plan(heat_after, budget_after, start_s)
    end_s = start_s + rest.end_s
    zero_s = start_s - plan.record.start_s if first else 0.0
    whole = replace_rest(planned.plan, first, rest, zero_s, budget_after, display.budget)
    plan_zero_s = start_s - zero_s
    whole_planned = replace(
        planned,
        plan=whole,
        predicted_m=np.concatenate([planned.predicted_m[:first], peaks.displacement_m]),
        heat=after.heat.copy_shifted(-plan_zero_s),
        budget=after.shift_to_plan(plan_zero_s)[1],
    )
    return RestartedPlan(
        plan=plan,
        start_s=start_s,
        zero_s=zero_s,
        planned=whole_planned,
        points=points.shift_rows(first),
        crc=proven.crc,
        summary_json=_summarize_again(whole_planned, plan.record.summary_json),
        before=before,
        after=after,
        end_s=end_s,
    )


def _is_made_for(display: DisplayModel, plan: ActivePlan) -> bool:
    """Return whether a plan was made for the stages that draw: a lost one has no points."""
    return all(drawing or not len(points) for drawing, points in zip(display.draws, plan.points.stages, strict=True))


def _plan_anew(
    display: DisplayModel,
    plan: ActivePlan,
    heat: ThermalState,
    budget: BudgetState,
    on_progress: Callable[[], None],
) -> tuple[LimitedPlan, BudgetState]:
    """Plan the rest of a plan for the present stages. Return its rows and the state after them.

    Pulses above a cap are trimmed, as after a pause, under each policy of the request.
    """
    sequence, sources = build_rest_sequence(plan.planned, plan.first_row, plan.origin_s)
    anew = plan_sequence(display, sequence, heat, budget, "trim", lambda _: on_progress())
    return replace(anew.plan, source=sources[anew.plan.source]), anew.budget


def _find_origin_s(plan: ActivePlan) -> float:
    """Return the time of the plan at which its points begin again: when the light went off, or shortly before a pulse.

    The mirrors need the lead-in before the first pulse.
    """
    start_s = plan.planned.plan.start_s
    if plan.first_row >= len(start_s):
        return plan.origin_s
    latest_s = float(start_s[plan.first_row]) - plan.planned.lead_in_s
    return float(np.floor(min(plan.origin_s, latest_s) * 1e6) * 1e-6)


def _summarize_again(planned: PlannedSequence, before_json: bytes) -> bytes:
    """Summarize a plan again.

    Its feasibility, first trimmed pulse, peaks of trains and times since earlier plans are those of its request.
    """
    before = PlanSummary.model_validate_json(before_json)
    summary = summarize_plan(planned)
    kept = {"feasibility": before.feasibility, "redrawn": before.redrawn}
    return summary.model_copy(update=kept).model_dump_json().encode()


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
        waits = bool(self._plans.waiting) and not self._plans.running
        return self.off_s is not None and waits and not self.is_held

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
