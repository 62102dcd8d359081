"""Heat and rest of plans that ended early or were interrupted.

An estimate may be too warm (a pulse that was cut short), never too cold: heat is taken back only by computing it again
from the executed pulses (`rewind_estimate`). What a plan has left after a pause, a cancelled plan before it, the loss
of a stage or light that would have been late is planned anew for the heat at which the light returns, limited and
proven again (decision 37). `ThermalMemory` keeps in shared memory what a later planner process continues from.
"""

import mmap
import pickle
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from math import inf
from typing import NamedTuple, Self
from uuid import uuid4

import numpy as np

from optodrive.core.errors import RefusedError
from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import BudgetState, ExecutedPulses, LimitedPlan, PulsePlan
from optodrive.core.types.push_options import Policy
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame, Train
from optodrive.daemon.engine.active_plan import ActivePlan, PlanRows, ThermalEstimate
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.proven_points import prove
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import commit_until
from optodrive.planning.limiter.rest import replace_rest
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.plan_summary import summarize_plan
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.planning.summary_schema import PlanSummary

DURATION_MIN_S = 1e-3
"""Duration of the rest of a frame whose time is over."""
CYCLE_ROUNDING = 0.01
"""Largest share of a train's cycle by which rounding to microseconds moves a pulse."""


class EndedPlan(NamedTuple):
    """Plan that ended early, with its executed pulses.

    start_s: board time of the plan's zero; executed, executed_rows: as in `ActivePlan`, None without a report
    dropped: number of pulses at the plan's end that the board will never get
    """

    start_s: float
    plan: PulsePlan
    dropped: int
    executed: ExecutedPulses | None
    executed_rows: IntArray | None

    @classmethod
    def from_plan(cls, plan: ActivePlan) -> Self:
        """Build it from a plan that waits, runs or has ended."""
        return cls(
            plan.record.start_s,
            PulsePlan(**{item.name: getattr(plan.planned.plan, item.name) for item in fields(PulsePlan)}),
            plan.rest_count if plan.is_interrupted else plan.record.dropped,
            plan.executed,
            plan.executed_rows,
        )


class EndedPlans(NamedTuple):
    """Consecutive plans that ended early.

    before: heat and budget before the first one, from its zero
    """

    before: ThermalEstimate
    plans: tuple[EndedPlan, ...]

    @classmethod
    def from_plans(cls, plans: Sequence[ActivePlan]) -> Self:
        """Build it from one plan or more that wait, run or have ended."""
        return cls(plans[0].before, tuple(map(EndedPlan.from_plan, plans)))


def rewind_estimate(
    ended: EndedPlans, gate_off_s: float, budget: Budget, on_progress: Callable[[], None], dark_s: float = -inf
) -> ThermalEstimate:
    """Build the estimate after plans that ended early, without their dropped pulses.

    The heat counts the executed pulses, and those that are not reported yet but were due before board time dark_s, when
    the gate was probably off. The budget counts every pulse that may have started before board time gate_off_s, when
    it is off for certain.
    """
    estimate, zero_s = ended.before, ended.plans[0].start_s
    for record in ended.plans:
        plan, before, zero_s = record.plan, estimate.shift(zero_s - record.start_s), record.start_s
        state = before.budget
        kept_pulses = len(plan) - record.dropped
        if kept_pulses:
            until_s = min(gate_off_s - record.start_s, float(np.nextafter(plan.start_s[kept_pulses - 1], inf)))
            kept = PulsePlan(**{item.name: getattr(plan, item.name)[:kept_pulses] for item in fields(PulsePlan)})
            state = commit_until(kept, until_s, state, budget, on_progress)
        estimate = ThermalEstimate(_apply_emitted(before.heat, record, dark_s), state)
    return estimate.shift(zero_s)


def _apply_emitted(before: ThermalState, record: EndedPlan, dark_s: float) -> ThermalState:
    """Return the heat after the executed pulses of a plan, and those that have no report but began before dark_s."""
    plan, late_s = record.plan, 0.0
    is_due = np.arange(len(plan)) < len(plan) - record.dropped
    if record.executed is not None and record.executed_rows is not None and len(record.executed):
        is_due[record.executed_rows] = False
        if not plan.stage.any():  # several boards emit nothing late
            late_s = max(0.0, float(record.executed.start_s[-1] - plan.start_s[record.executed_rows[-1]]))
    start_s, until_s = plan.start_s + late_s, dark_s - record.start_s
    row = np.flatnonzero(is_due & (start_s < until_s))
    width_s = np.minimum(plan.width_s, until_s - start_s)
    columns = [plan.pixel[row], start_s[row], width_s[row], plan.power_w[row]]
    if record.executed is not None:
        reported = [getattr(record.executed, name) for name in ("pixel", "start_s", "width_s", "power_w")]
        columns = [np.concatenate(pair) for pair in zip(reported, columns, strict=True)]
    order = np.argsort(columns[1], kind="stable")
    pixel, begin_s, on_time_s, power_w = (column[order] for column in columns)
    heat = before.copy()
    heat.apply_pulses(pixel, begin_s, on_time_s, power_w)
    return heat


def estimate_before_rest(plan: ActivePlan, budget: Budget, on_progress: Callable[[], None]) -> ThermalEstimate:
    """Build the estimate before a plan that waits, or before the rest of one that was interrupted."""
    if plan.first_row:
        ended = EndedPlan.from_plan(plan)._replace(dropped=plan.rest_count)
        return rewind_estimate(EndedPlans.from_plans([plan])._replace(plans=(ended,)), inf, budget, on_progress, inf)
    return plan.before.shift(plan.record.start_s)


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


class Restart(NamedTuple):
    """Plans in their order before and after they were made again.

    start_s: board time at which the first one's points begin; end_s: of the last pulse
    before, after: heat and budget before and after all, in board time
    """

    plans: tuple[ActivePlan, ...]
    restarted: tuple[ActivePlan, ...]
    start_s: float
    end_s: float
    before: ThermalEstimate
    after: ThermalEstimate


def restart_plans(
    display: DisplayModel,
    scales: Sequence[WireScale],
    plans: tuple[ActivePlan, ...],
    start_s: float,
    gap_s: float,
    on_progress: Callable[[], None],
) -> Restart:
    """Plan, limit and prove plans that follow each other again.

    start_s: board time at which the first one begins, once the light before it is over; gap_s: between two plans
    Raise LocalProtocolError if the bytes of one exceed a cap, and what on_progress raises.
    """
    restarted: list[ActivePlan] = []
    before = estimate = estimate_before_rest(plans[0], display.budget, on_progress)
    start_s = end_s = max(start_s, estimate.budget.at_s)
    for plan in plans:
        begin_s = start_s if not restarted else max(end_s + gap_s, estimate.budget.at_s)
        again, estimate, end_s = _restart(display, scales, plan, estimate, begin_s, on_progress)
        restarted.append(again)
    return Restart(plans, tuple(restarted), start_s, end_s, before, estimate)


def _restart(
    display: DisplayModel,
    scales: Sequence[WireScale],
    plan: ActivePlan,
    before: ThermalEstimate,
    start_s: float,
    on_progress: Callable[[], None],
) -> tuple[ActivePlan, ThermalEstimate, float]:
    """Return a plan as it goes on, heat and budget after it, and the board time of its end.

    before: heat and budget before it, in board time; start_s: at which its points begin
    """
    first, planned = plan.first_row, plan.planned
    if plan.growth is not None:
        plan.growth.on_progress = lambda _: on_progress()
        planned = plan.growth.plan_until()
    before = before.shift(-start_s)
    rest, budget_after = _plan_anew(display, plan, before, on_progress)
    points = StagePoints.from_plan(rest, scales, display.draws)
    on_progress()
    proven = prove(rest, points, scales, before.budget, display.budget, on_progress)
    heat = before.heat.copy()
    peaks = heat.apply_pulses(rest.pixel, rest.start_s, rest.width_s, rest.power_w, on_progress)
    after = ThermalEstimate(heat, budget_after).shift(start_s)
    zero_s = start_s - plan.record.start_s if first else 0.0
    after_whole = after.shift(zero_s - start_s)
    planned = replace(
        planned,
        plan=replace_rest(planned.plan, first, rest, zero_s, budget_after, display.budget),
        predicted_m=np.concatenate([planned.predicted_m[:first], peaks.displacement_m]),
        heat=after_whole.heat,
        budget=after_whole.budget,
    )
    summary_json = _summarize_again(planned, plan.record.summary_json)
    rows = PlanRows(planned, points.shift_rows(first), proven.crc, summary_json)
    restarted = replace(
        plan.rebase(plan.record.start_s if first else start_s, rows=rows),
        before=plan.before if first else before,
        is_interrupted=False,
        zero_s=zero_s,
        origin_s=zero_s,
        initial_pixels=None,
    )
    return restarted, after, start_s + rest.end_s


def _plan_anew(
    display: DisplayModel,
    plan: ActivePlan,
    before: ThermalEstimate,
    on_progress: Callable[[], None],
) -> tuple[LimitedPlan, BudgetState]:
    """Plan the rest of a plan for the heat before it and the present stages. Return its rows and the state after them.

    Pulses above a cap are delayed if caps delayed the plan before, and trimmed under each other policy of the request.
    """
    sequence, sources = build_rest_sequence(plan.planned, plan.first_row, plan.origin_s)
    policies: tuple[Policy, ...] = ("delay", "trim") if plan.planned.delays else ("trim",)
    for policy in policies:
        with suppress(RefusedError):  # of a pulse that never fits, as on a display that was dimmed
            anew = plan_sequence(display, sequence, before.heat, before.budget, policy, lambda _: on_progress())
            break
    # As the plan's own rows state them: a later pause finds the cycles that are left by that.
    parts, whole = ((*each.frames, *each.trains) for each in (sequence, plan.planned.sequence))
    shifts_s = [_find_mark_s(whole[at]) - _find_mark_s(part) for part, at in zip(parts, sources, strict=True)]
    requested_s = anew.plan.requested_start_s + plan.planned.lead_in_s - anew.lead_in_s
    if len(anew.plan):
        requested_s = requested_s + np.array(shifts_s)[anew.plan.source]
    return replace(anew.plan, source=sources[anew.plan.source], requested_start_s=requested_s), anew.budget


def _find_mark_s(request: TactileFrame | Train) -> float:
    """Return a time that a request and its rest have in common: when a frame is shown, or when a train ends."""
    return request.show_at_s if isinstance(request, TactileFrame) else request.start_s + request.duration_s


def _summarize_again(planned: PlannedSequence, before_json: bytes) -> bytes:
    """Summarize a plan again.

    Its feasibility, first trimmed pulse, peaks of trains and times since earlier plans are those of its request.
    """
    before = PlanSummary.model_validate_json(before_json)
    summary = summarize_plan(planned)
    kept = {"feasibility": before.feasibility, "redrawn": before.redrawn}
    return summary.model_copy(update=kept).model_dump_json().encode()


SLOT_BYTES = 256 * 2**20
"""Room for one state. Memory that was never written costs nothing."""
HEADER = struct.Struct("<QQ")
"""Sequence number and length of a state; sequence number 0: none."""
LENGTH = struct.Struct("<Q")
SHARE = struct.Struct("<d")


class SavedThermalState(NamedTuple):
    """State at a host time and the board time then, s.

    estimate: after all plans; ended: those that were running, or the first that waited, whose pulses `estimate` counts
    """

    host_s: float
    board_s: float
    estimate: ThermalEstimate
    ended: EndedPlans | None


class ThermalMemory:
    """Two slots that are written in turn, so that a process which ends while it writes leaves the older state.

    A slot gets its number once it is whole. No checksum is needed: the stores of a process that was killed are those of
    its instructions up to there. The supervisor creates it before it forks the planner. One process at a time uses it.
    owner: mark of the daemon, the same for all its planners
    """

    def __init__(self) -> None:
        self._map = mmap.mmap(-1, 2 * SLOT_BYTES + SHARE.size)
        self._sequence = 0
        self.owner = uuid4().hex
        self.power_share = 1.0

    @property
    def power_share(self) -> float:
        """Largest power of a pulse as a share of the laser's, as it was set last."""
        share: float = SHARE.unpack_from(self._map, 2 * SLOT_BYTES)[0]
        return share

    @power_share.setter
    def power_share(self, share: float) -> None:
        SHARE.pack_into(self._map, 2 * SLOT_BYTES, share)

    def save(self, state: SavedThermalState) -> None:
        """Save a state. Raise ValueError if it exceeds its room."""
        arrays: list[pickle.PickleBuffer] = []
        frame = pickle.dumps(state, pickle.HIGHEST_PROTOCOL, buffer_callback=arrays.append)
        parts = [memoryview(frame), *(array.raw() for array in arrays)]  # the arrays are copied once, to their place
        total_bytes = sum(LENGTH.size + part.nbytes for part in parts)
        if total_bytes > SLOT_BYTES - HEADER.size:
            raise ValueError(f"a thermal state of {total_bytes} bytes exceeds its room")
        self._sequence += 1
        begin = self._sequence % 2 * SLOT_BYTES
        position = begin + HEADER.size
        for part in parts:
            LENGTH.pack_into(self._map, position, part.nbytes)
            position += LENGTH.size
            self._map[position : position + part.nbytes] = part
            position += part.nbytes
        HEADER.pack_into(self._map, begin, self._sequence, total_bytes)

    def load(self) -> SavedThermalState | None:
        """Return the newest state, None if none was saved, and continue after it."""
        slots = [(HEADER.unpack_from(self._map, begin), begin) for begin in (0, SLOT_BYTES)]
        (sequence, length), begin = max(slots)
        if not sequence:
            return None
        self._sequence = sequence
        parts = self._read_parts(begin + HEADER.size, length)
        state: SavedThermalState = pickle.loads(parts[0], buffers=parts[1:])  # noqa: S301 - this program wrote it
        return state

    def _read_parts(self, begin: int, length: int) -> list[bytearray]:
        """Return copies of the parts of a state, the pickled frame first."""
        parts, position = [], begin
        while position < begin + length:
            (part_bytes,) = LENGTH.unpack_from(self._map, position)
            position += LENGTH.size
            parts.append(bytearray(self._map[position : position + part_bytes]))
            position += part_bytes
        return parts
