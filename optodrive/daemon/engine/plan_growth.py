"""The rest of a streamed frame, planned while its first part plays.

Of a streamed frame only what can be played before the next one arrives is planned at once: the plan is accepted, and
its points leave, with a `SequencePlanner` that stands behind its last pulse. If no newer frame has replaced the plan
by the time at which the points behind it must leave, that planner goes on: the same pulses as if the frame had been
planned as a whole, limited from the budget after the first part and proven as bytes, like those (decision 55).
"""

import zlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.push import Push
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.proven_points import prove
from optodrive.planning.pipeline import SequencePlanner
from optodrive.planning.plan_summary import summarize_plan
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.planning.stimuli.frame_json import FRAME_DURATION_S, can_split


class ExtendedPlan(NamedTuple):
    """A plan with its rest.

    points: of the whole plan; added: those behind the first part; crc, added_crc: CRC-32 of the bytes of both
    """

    planned: PlannedSequence
    points: StagePoints
    added: StagePoints
    crc: int
    added_crc: int
    summary_json: bytes


def may_grow(push: Push, sequence: FrameSequence, stages: int) -> bool:
    """Return whether a push may be planned in parts.

    Its answer is about the first one. Several boards end each job together, with the gate off, and a policy other than
    "trim" may refuse or delay the whole for a pulse of the rest.
    """
    answers_whole = not push.streamed or push.lists_pulses
    return not answers_whole and push.options.get("policy", "trim") == "trim" and can_split(sequence) and stages == 1


def grow_plan(
    plan: ActivePlan, growth: SequencePlanner, scales: Sequence[WireScale], on_progress: Callable[[float], None]
) -> ExtendedPlan:
    """Plan, limit and quantise the rest of a plan, and verify its decoded bytes against the budget.

    Raise LocalProtocolError if a pulse exceeds a cap, or if points of the first part would change.
    """
    display, first, budget = growth.display, len(plan.planned.plan), plan.planned.budget
    growth.on_progress = on_progress
    planned = growth.plan_until()
    points = StagePoints.from_plan(planned.plan, scales, display.draws)
    added = points.split_behind(plan.points)
    proven = prove(planned.plan, points, scales, budget, display.budget, lambda: on_progress(1.0), first)
    pulsed_s = None if plan.cycle is None else plan.cycle.pulsed_s - plan.record.start_s
    return ExtendedPlan(
        planned=planned,
        points=points,
        added=added,
        crc=proven.crc,
        added_crc=zlib.crc32(added.encode_payload()),
        summary_json=summarize_plan(planned, None, pulsed_s).model_dump_json().encode(),
    )


def build_rest_frame(plan: ActivePlan) -> FrameSequence:
    """Return the frame of the pixels that a streamed plan has dropped, or has not planned yet."""
    plan_rows = plan.planned.plan.pixel
    target_m = np.zeros(len(plan.heat_before.pixels))
    left = np.concatenate([plan_rows[len(plan_rows) - plan.record.dropped :], plan.unplanned_pixels])
    target_m[left] = plan.planned.sequence_target_m[left]
    return FrameSequence((TactileFrame(plan.record.name, 0.0, FRAME_DURATION_S, target_m),))
