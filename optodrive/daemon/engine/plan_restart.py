"""Plans that go on after a pause: their rows that are left, limited and proven again from the heat that is left.

The rows of a plan fix which stage draws what. Once a stage was lost, what is left of a plan that was made with it,
frames and parts of trains, is planned anew from the request, and so is each plan not yet begun.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import BudgetState, LimitedPlan
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame, Train
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.proven_points import prove
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
    if display.draws.all() or (first and _is_made_for(display, plan)):
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
