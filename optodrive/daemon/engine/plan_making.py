"""Plan of a sequence from a planning snapshot, with the wire points and their proof."""

import threading
from collections.abc import Callable, Sequence
from math import inf
from typing import NamedTuple

from optodrive.core.types.arrays import IntArray
from optodrive.core.types.stimuli import FrameSequence
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.plan_growth import may_grow
from optodrive.daemon.engine.plan_record import LargestTarget, PlanRecord
from optodrive.daemon.engine.planning_snapshot import PlanningSnapshot
from optodrive.daemon.engine.request_body import BuiltRequest
from optodrive.daemon.push import Push
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.proven_points import prove
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.pipeline import SequencePlanner
from optodrive.planning.plan_summary import summarize_plan
from optodrive.planning.pulse_table import PulseTable
from optodrive.planning.stimuli.frame_json import can_split, delay_frames, stale_pixels_first
from optodrive.planning.stimuli.standing_page import Refresh

NEVER = threading.Event()
"""Event of a caller that does not leave."""


class PlanningRequest(NamedTuple):
    """Request for a plan.

    build: returns the sequence, with labels and parameters for report and recording
    arrived_s: board time of the push's arrival; caller_left: set when the caller no longer waits
    select: returns what is drawn next of a sequence that is a standing page, None for any other sequence
    """

    build: Callable[[], BuiltRequest]
    push: Push
    arrived_s: float = 0.0
    caller_left: threading.Event = NEVER
    select: Callable[[DisplayModel, FrameSequence, PlanningSnapshot], Refresh] | None = None


def make_plan(
    display: DisplayModel,
    scales: Sequence[WireScale],
    request: PlanningRequest,
    built: BuiltRequest,
    snapshot: PlanningSnapshot,
    plan_id: str,
    on_progress: Callable[[float], None],
    horizon_s: float = inf,
) -> ActivePlan:
    """Plan a sequence, quantise the plan, and verify the decoded bytes against the budget.

    horizon_s: time of the plan up to which it is planned, if `may_grow` permits, and the plan to grow
    Raises InputError and RefusedError as `plan_sequence` and `check_feasibility` do, and what on_progress raises.
    """
    push = request.push
    growth, feasibility = None, None
    if push.streamed:
        growth = _begin_streamed(display, request, built.sequence, snapshot, on_progress)
        is_page = request.select is not None
        planned = growth.plan_until(horizon_s if not is_page and may_grow(push, built.sequence, len(scales)) else inf)
    else:
        heat, budget = snapshot.heat, snapshot.budget
        planned, feasibility = check_feasibility(display, built.sequence, heat, budget, on_progress, **push.options)
    on_progress(1.0)
    pulsed_s = None if snapshot.cycle is None else snapshot.cycle.pulsed_s - snapshot.start_s
    points = StagePoints.from_plan(planned.plan, scales, display.draws)
    if growth is not None and not growth.is_complete and not points.ends_with_gate_on:
        # The mirrors would point at the next lit pulse already, which is not planned yet.
        planned = growth.plan_until()
        points = StagePoints.from_plan(planned.plan, scales, display.draws)
    on_progress(1.0)
    proven = prove(planned.plan, points, scales, snapshot.budget, display.budget, lambda: on_progress(1.0))
    on_progress(1.0)
    record = PlanRecord(
        plan_id=plan_id,
        name=push.name,
        pulse_count=len(planned.plan),
        duration_s=planned.duration_s,
        summary_json=summarize_plan(planned, feasibility, pulsed_s).model_dump_json().encode(),
        pulses=PulseTable.from_planned(planned),
        largest_target=LargestTarget.from_planned(planned),
        start_s=snapshot.start_s,
        arrived_s=request.arrived_s,
        arrived_host_s=push.arrived_s,
        caller=push.caller,
        labels=dict(built.labels),
        parameters=dict(built.parameters),
        streamed=push.streamed,
        refreshes=push.refreshes,
        first_pulse_s=float(proven.pulses.start_s.min()) if len(proven.pulses.start_s) else None,
    )
    return ActivePlan(
        record=record,
        planned=planned,
        points=points,
        heat_before=snapshot.heat,
        budget_before=snapshot.budget,
        epoch=push.epoch,
        crc=proven.crc,
        growth=None if growth is None or growth.is_complete else growth,
        cycle=snapshot.cycle,
        initial_pixels=snapshot.initial_pixels,
    )


def _begin_streamed(
    display: DisplayModel,
    request: PlanningRequest,
    sequence: FrameSequence,
    snapshot: PlanningSnapshot,
    on_progress: Callable[[float], None],
) -> SequencePlanner:
    """Begin to plan a streamed sequence."""
    orders: dict[int, IntArray] = {}
    if request.select is not None:
        sequence, orders = request.select(display, sequence, snapshot)
    elif snapshot.cycle is not None and can_split(sequence):
        sequence = stale_pixels_first(sequence, snapshot.cycle.refreshed)
        is_beam_free = snapshot.predecessor is None or snapshot.pause_s > 0.0
        order = snapshot.cycle.find_order(sequence.frames[0].target_m) if is_beam_free else None
        if order is not None and len(sequence.frames) == 1:
            orders = {0: order}
    if snapshot.pause_s and request.select is None:
        sequence = delay_frames(sequence, snapshot.pause_s)
    policy, pixels = request.push.options.get("policy", "trim"), snapshot.initial_pixels
    heat, budget = snapshot.heat, snapshot.budget
    return SequencePlanner(display, sequence, heat, budget, policy, on_progress, pixels, orders)
