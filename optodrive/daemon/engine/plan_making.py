"""Plan of a sequence from a planning snapshot, with the wire points and their proof."""

import threading
import zlib
from collections.abc import Callable
from typing import NamedTuple

from optodrive.core.types.policy import Policy
from optodrive.core.types.stimuli import FrameSequence
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.planning_snapshot import PlanningSnapshot
from optodrive.link.protocol.quantisation import WireScale, decode, quantise
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.feasibility.report import FeasibilityReport, FitMode
from optodrive.planning.limiter.limiter import verify
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.planning.stimuli.streamed_frame import can_split, stale_pixels_first

NEVER = threading.Event()
"""Event of a caller that does not leave."""


class PlanningRequest(NamedTuple):
    """Request for a plan.

    build: returns the sequence
    streamed: replace everything not yet sent; the next streamed plan replaces this one in the same way
    arrived_s: board time of the request's arrival; epoch: in which it arrived
    caller: name of the token that submitted it; caller_left: set when the caller no longer waits
    """

    build: Callable[[], FrameSequence]
    name: str
    policy: Policy = "trim"
    fit: FitMode = "as_is"
    streamed: bool = False
    arrived_s: float = 0.0
    epoch: int = 0
    caller: str = ""
    caller_left: threading.Event = NEVER


def make_record(
    display: DisplayModel,
    scale: WireScale,
    request: PlanningRequest,
    sequence: FrameSequence,
    snapshot: PlanningSnapshot,
    plan_id: str,
    on_progress: Callable[[float], None],
) -> PlanRecord:
    """Plan a sequence, quantise the plan, and verify the decoded bytes against the budget.

    Raises InputError and RefusedError as `plan_sequence` and `check_feasibility` do, and what on_progress raises.
    """
    planned, feasibility = _plan(display, request, sequence, snapshot, on_progress)
    on_progress(1.0)
    points = quantise(planned.plan, scale)
    on_progress(1.0)
    payload = points.encode_payload()
    decoded = decode(payload, scale)
    verify(planned.plan, points.row[decoded.index], decoded, snapshot.budget, display.budget, lambda: on_progress(1.0))
    on_progress(1.0)
    return PlanRecord(
        plan_id=plan_id,
        name=request.name,
        planned=planned,
        feasibility=feasibility,
        points=points,
        heat_before=snapshot.heat,
        budget_before=snapshot.budget,
        start_s=snapshot.start_s,
        arrived_s=request.arrived_s,
        epoch=request.epoch,
        crc=zlib.crc32(payload),
        caller=request.caller,
        streamed=request.streamed,
        refreshed=snapshot.refreshed,
    )


def _plan(
    display: DisplayModel,
    request: PlanningRequest,
    sequence: FrameSequence,
    snapshot: PlanningSnapshot,
    on_progress: Callable[[float], None],
) -> tuple[PlannedSequence, FeasibilityReport | None]:
    """Plan the sequence, with a feasibility check unless it is streamed."""
    heat, budget = snapshot.heat, snapshot.budget
    if not request.streamed:
        return check_feasibility(display, sequence, heat, budget, request.policy, on_progress, request.fit)
    if snapshot.refreshed is not None and can_split(sequence):
        sequence = stale_pixels_first(sequence, snapshot.refreshed)
    initial_pixel = snapshot.initial_pixel
    return plan_sequence(
        display, sequence, heat, budget, request.policy, on_progress, initial_pixel=initial_pixel
    ), None
