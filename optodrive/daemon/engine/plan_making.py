"""Plan of a sequence from a planning snapshot, with the wire points and their proof.

A snapshot states from where a plan begins: its zero, and heat and budget at that time, behind everything accepted or
behind the points of a running stream that cannot be withdrawn any more. `Dimmer` states the display by which plans are
made, with a lower cap on the power, or without a lost stage.

Of a streamed frame only what can be played before the next one arrives is planned at once: the plan is accepted, and
its points leave, with a `SequencePlanner` that stands behind its last pulse. If no newer frame has replaced the plan
by the time at which the points behind it must leave, that planner goes on: the same pulses as if the frame had been
planned as a whole, limited from the budget after the first part and proven as bytes, like those.
"""

import threading
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, nan
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import IntArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine.active_plan import ActivePlan, PlanRows, RefreshCycle, ThermalEstimate, describe_rows
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.engine.plan_rest import ThermalMemory
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.stage_points import PointCut, StagePoints
from optodrive.link.proven_points import prove
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import commit_until
from optodrive.planning.pipeline import SequencePlanner
from optodrive.planning.plan_summary import summarize_plan
from optodrive.planning.stimuli.frame_json import FRAME_DURATION_S, can_split, delay_frames, stale_pixels_first
from optodrive.planning.stimuli.standing_page import Refresh


@dataclass(frozen=True, eq=False)
class PlanningSnapshot:
    """Initial state of a plan.

    thermal: estimate from which the snapshot was derived; the snapshot is stale once the queue has another one
    start_s: board time of the plan's zero
    before: heat and budget at that time, from the plan's zero
    predecessor, cut: running plan that the new one truncates, and where
    initial_pixels: pixel at which the mirrors of each stage point at the plan's zero; None if one is unknown
    cycle: when the stream has drawn each pixel last, None if no stream was before
    pause_s: time of the plan before which a frame is not drawn, so that frames keep the rhythm in which they arrive
    """

    thermal: ThermalEstimate
    start_s: float
    before: ThermalEstimate
    predecessor: ActivePlan | None = None
    cut: PointCut | None = None
    initial_pixels: tuple[int, ...] | None = None
    cycle: RefreshCycle | None = None
    pause_s: float = 0.0

    @property
    def is_beam_free(self) -> bool:
        """Whether the plan begins behind a pause, or follows nothing."""
        return self.predecessor is None or self.pause_s > 0.0

    def await_beat(self, display: DisplayModel, sequence: FrameSequence, interval_s: float) -> "PlanningSnapshot":
        """Return the snapshot for a streamed frame that begins in its rhythm, if the frame before had the same pixels.

        interval_s: mean interval between frames
        """
        order = self.cycle.find_order(sequence.frames[0].target_m) if self.cycle and sequence.frames else None
        if self.cycle is None or order is None or not self.is_beam_free:
            return self
        # Without known mirrors the plan's own lead-in comes first.
        lead_ins_us = [0] if self.initial_pixels else [head.settling.lead_in_us for head in display.scan_heads]
        ready_s = self.start_s + self.pause_s + 1e-6 * max(lead_ins_us)
        wait_s = float(np.floor((self.cycle.find_beat_s(int(order[0]), interval_s, ready_s) - ready_s) * 1e6)) * 1e-6
        if self.predecessor is not None:
            return replace(self, pause_s=self.pause_s + wait_s)
        # A later zero leaves the planning as much more time.
        return replace(self, start_s=self.start_s + wait_s, before=self.before.shift(-wait_s))


def build_cut_snapshot(
    running: ActivePlan,
    thermal: ThermalEstimate,
    min_start_s: float,
    budget: Budget,
    tick_s: float,
    min_end_s: float = inf,
    begin_s: float = -inf,
) -> PlanningSnapshot | None:
    """Build the snapshot for truncating a running plan before its first point after board time min_start_s.

    min_end_s: board time at which the plan may end for another to follow it if nothing of it can be dropped; that one
    then begins at begin_s
    Return None if no pulse would be left of a plan that does not hold its first point, or none would be dropped and it
    ends too early.
    """
    plan, zero_s = running.planned.plan, running.record.start_s
    min_tick = (min_start_s - zero_s - running.zero_s) / tick_s
    cut = PointCut.find(running.points, min_tick if running.holds_first else max(1.0, min_tick))
    end_s = running.zero_s + cut.end_tick * tick_s
    is_whole = cut.row == len(plan)
    if (is_whole and zero_s + end_s < min_end_s) or (not cut.row and any(cut.kept_points)):
        return None
    kept = slice(cut.row)
    heat = running.before.heat.copy()
    heat.apply_pulses(plan.pixel[kept], plan.start_s[kept], plan.width_s[kept], plan.power_w[kept])
    until_s = inf if is_whole else float(plan.start_s[cut.row])
    state = commit_until(plan, until_s, running.before.budget, budget)
    return PlanningSnapshot(
        thermal=thermal,
        start_s=zero_s + end_s,
        before=ThermalEstimate(heat, state).shift(-end_s),
        predecessor=running,
        cut=cut,
        initial_pixels=_find_initial_pixels(running, cut),
        cycle=continue_cycle(running, cut.row) if cut.row else running.cycle,
        pause_s=max(0.0, begin_s - zero_s - end_s) if is_whole else 0.0,
    )


def _find_initial_pixels(running: ActivePlan, cut: PointCut) -> tuple[int, ...] | None:
    """Return the pixels at which the mirrors point at the end of the kept points."""
    pixels: list[int] = []
    for stage, (row, points) in enumerate(zip(cut.aim_rows, running.points.stages, strict=True)):
        if row >= 0 or not len(points):  # a lost stage has no points, and its mirrors no place
            pixels.append(int(running.planned.plan.pixel[row]))
        elif running.initial_pixels is not None and not cut.kept_points[stage]:
            pixels.append(running.initial_pixels[stage])
        else:
            return None
    return tuple(pixels)


def continue_cycle(streamed: ActivePlan, row: int) -> RefreshCycle:
    """Return the refresh cycle after the first `row` pulses of a plan.

    If what is left contains no pixel that is still to be drawn, a new cycle begins.
    """
    plan, zero_s = streamed.planned.plan, streamed.record.start_s
    if streamed.cycle is None:
        pixels = len(streamed.before.heat.pixels)
        drawn_s, pulsed_s, width_s = np.full(pixels, -inf), np.full(pixels, -inf), np.full(pixels, nan)
        begun_s = zero_s
    else:
        drawn_s, pulsed_s, width_s = (column.copy() for column in streamed.cycle[:3])
        begun_s = streamed.cycle.begun_s
    drawn_s[[pulse.pixel for pulse in streamed.planned.skipped]] = zero_s  # their heat holds them up
    drawn_s[plan.pixel[:row]] = pulsed_s[plan.pixel[:row]] = zero_s + plan.start_s[:row]
    width_s[plan.pixel[:row]] = plan.width_s[:row]
    left = np.concatenate([plan.pixel[row:], streamed.unplanned_pixels])
    end_s = zero_s + float((plan.start_s + plan.width_s)[:row].max(initial=0.0))
    return RefreshCycle(drawn_s, pulsed_s, width_s, end_s if (drawn_s[left] >= begun_s).all() else begun_s)


def dim_display(display: DisplayModel, share: float) -> DisplayModel:
    """Return a display whose pulses have at most a share of the laser's power, never more than configured."""
    caps = display.budget.caps
    if share >= caps.power_share:
        return display
    scan_heads = tuple(replace(each, drive=replace(each.drive, is_fine=False)) for each in display.scan_heads)
    budget = display.budget._replace(caps=caps._replace(power_share=share))
    return replace(display, scan_heads=scan_heads, budget=budget)


class Dimmer:
    """The display by which plans are made. Any thread may read `display`, which changes as a whole.

    lost_stage: the stage without which they are made, None for all stages
    memory: keeps the share for a later planner process, so that a restart brightens nothing
    """

    def __init__(self, display: DisplayModel, memory: ThermalMemory) -> None:
        self._full = display
        self._memory = memory
        self.lost_stage: int | None = None
        self.display = dim_display(display, memory.power_share)

    @property
    def power_share(self) -> float:
        """Largest power of a pulse as a share of the laser's."""
        return self.display.budget.caps.power_share

    def set_share(self, share: float) -> None:
        """Set the share for the plans from now on. Raise InputError above the configured one."""
        configured = self._full.budget.caps.power_share
        if not 0.0 <= share <= configured:
            raise InputError("share", share, f"a number from 0 to {configured:g}, limits.power_share as configured")
        if 0.0 < share < 1.0 and any(laser.is_on_off for laser in self._full.config.lasers):
            raise InputError("share", share, "0 or 1: with laser.modulation 'on_off' a pulse has full power")
        self._memory.power_share = share
        self._build_display()

    def set_lost_stage(self, stage: int | None) -> None:
        """Make the plans from now on without a stage, None for all stages."""
        if stage != self.lost_stage:
            self.lost_stage = stage
            self._build_display()

    def _build_display(self) -> None:
        self.display = dim_display(self._full.without_stage(self.lost_stage), self._memory.power_share)


class ExtendedPlan(NamedTuple):
    """A plan with its rest: all rows, and the points behind the first part with the CRC-32 of their bytes."""

    rows: PlanRows
    added: StagePoints
    added_crc: int


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
    summary_json = summarize_plan(planned, None, pulsed_s).model_dump_json().encode()
    rows = PlanRows(planned, points, proven.crc, summary_json)
    return ExtendedPlan(rows, added, zlib.crc32(added.encode_payload()))


def build_rest_frame(plan: ActivePlan) -> FrameSequence:
    """Return the frame of the pixels that a streamed plan has dropped, or has not planned yet."""
    plan_rows = plan.planned.plan.pixel
    target_m = np.zeros(len(plan.before.heat.pixels))
    left = np.concatenate([plan_rows[len(plan_rows) - plan.record.dropped :], plan.unplanned_pixels])
    target_m[left] = plan.planned.sequence_target_m[left]
    return FrameSequence((TactileFrame(plan.record.name, 0.0, FRAME_DURATION_S, target_m),))


NEVER = threading.Event()
"""Event of a caller that does not leave."""


class DryRunStart(NamedTuple):
    """State of the display at the start of a plan that is submitted now.

    before: heat and budget, from the plan's zero; starts_in_s: time from now to that start
    power_share: to which the display is dimmed
    lost_stage: the stage that was lost while the others go on, None without
    """

    before: ThermalEstimate
    starts_in_s: float
    power_share: float = 1.0
    lost_stage: int | None = None


class PlanningRequest(NamedTuple):
    """Request for a plan.

    build: returns the sequence, with labels and parameters for report and recording
    arrived_s: board time of the push's arrival; caller_left: set when the caller no longer waits
    interval_s: mean interval between the latest frames of its stream, infinity without
    select: returns what is drawn next of a sequence that is a standing page, None for any other sequence
    """

    build: Callable[[], BuiltRequest]
    push: Push
    arrived_s: float = 0.0
    caller_left: threading.Event = NEVER
    select: Callable[[DisplayModel, FrameSequence, PlanningSnapshot], Refresh] | None = None
    interval_s: float = inf


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
        if request.select is None:
            snapshot = snapshot.await_beat(display, built.sequence, request.interval_s)
        growth = _begin_streamed(display, request, built.sequence, snapshot, on_progress)
        # What leaves the range of a discovered term's data is refused as a whole, before any of it is played.
        is_whole = request.select is not None or display.parameters.discovered
        planned = growth.plan_until(horizon_s if not is_whole and may_grow(push, built.sequence, len(scales)) else inf)
    else:
        heat, budget = snapshot.before.heat, snapshot.before.budget
        planned, feasibility = check_feasibility(display, built.sequence, heat, budget, on_progress, **push.options)
    on_progress(1.0)
    pulsed_s = None if snapshot.cycle is None else snapshot.cycle.pulsed_s - snapshot.start_s
    points = StagePoints.from_plan(planned.plan, scales, display.draws)
    if growth is not None and not growth.is_complete and not points.ends_with_gate_on:
        # The mirrors would point at the next lit pulse already, which is not planned yet.
        planned = growth.plan_until()
        points = StagePoints.from_plan(planned.plan, scales, display.draws)
    on_progress(1.0)
    proven = prove(planned.plan, points, scales, snapshot.before.budget, display.budget, lambda: on_progress(1.0))
    on_progress(1.0)
    record = PlanRecord(
        plan_id=plan_id,
        name=push.name,
        summary_json=summarize_plan(planned, feasibility, pulsed_s).model_dump_json().encode(),
        **describe_rows(planned),
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
        before=snapshot.before,
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
        order = snapshot.cycle.find_order(sequence.frames[0].target_m) if snapshot.is_beam_free else None
        if order is not None and len(sequence.frames) == 1:
            orders = {0: order}
    if snapshot.pause_s and request.select is None:
        sequence = delay_frames(sequence, snapshot.pause_s)
    policy, pixels = request.push.options.get("policy", "trim"), snapshot.initial_pixels
    heat, budget = snapshot.before.heat, snapshot.before.budget
    return SequencePlanner(display, sequence, heat, budget, policy, on_progress, pixels, orders)
