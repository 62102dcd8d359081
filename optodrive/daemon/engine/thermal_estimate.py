"""Heat and budget on the board's time line, as the daemon estimates them: after plans, and for its successor.

An estimate is a value: heat (best estimate) and budget (bound) after all pulses planned so far. `QueueThermal` holds
that of the queue, and replaces it at early ends, delays and restarts. `ThermalMemory` keeps in shared memory what a
later planner process continues from.
"""

import mmap
import pickle
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from math import inf
from typing import NamedTuple, Self
from uuid import uuid4

import numpy as np

from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import BudgetState, ExecutedPulses, PulsePlan
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.link.service.remote_session import RemoteSession
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import commit_until, shift_state


@dataclass(frozen=True, eq=False)
class ThermalEstimate:
    """Heat (best estimate) and budget (bound) after all pulses planned so far, in board time."""

    heat: ThermalState
    budget: BudgetState

    def shift_to_plan(self, start_s: float) -> tuple[ThermalState, BudgetState]:
        """Return both on the time line of a plan whose zero is board time start_s."""
        return self.heat.copy_shifted(-start_s), shift_state(self.budget, -start_s)

    def compute_cooling_m(self, from_s: float, to_s: float) -> float:
        """Return the largest decrease of a pixel's displacement between two board times, m.

        The heat of an absorber counts as the displacement to which it leads: shortly after a pulse only that decreases.
        """
        before, after = self.heat.state_at(from_s), self.heat.state_at(to_s)
        to_come_m = 0.5 * self.heat.pixels.kappa_m_per_k * (before.absorber_k - after.absorber_k)
        return float(np.max(np.maximum(before.displacement_m - after.displacement_m, to_come_m)))

    @classmethod
    def from_plan(cls, heat: ThermalState, budget: BudgetState, start_s: float) -> "ThermalEstimate":
        """Build the estimate from states on the time line of a plan whose zero is board time start_s."""
        return cls(heat.copy_shifted(start_s), shift_state(budget, start_s))

    def with_delay(self, delay_s: float) -> "ThermalEstimate":
        """Return the estimate with every pulse delay_s later."""
        return ThermalEstimate(self.heat.copy_shifted(delay_s), shift_state(self.budget, delay_s))


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

    heat_before, budget_before: initial state of the first one, on its own time line
    """

    heat_before: ThermalState
    budget_before: BudgetState
    plans: tuple[EndedPlan, ...]

    @classmethod
    def from_plans(cls, plans: Sequence[ActivePlan]) -> Self:
        """Build it from one plan or more that wait, run or have ended."""
        return cls(plans[0].heat_before, plans[0].budget_before, tuple(map(EndedPlan.from_plan, plans)))


def rewind_estimate(
    ended: EndedPlans, gate_off_s: float, budget: Budget, on_progress: Callable[[], None], dark_s: float = -inf
) -> ThermalEstimate:
    """Build the estimate after plans that ended early, without their dropped pulses.

    The heat counts the executed pulses, and those that are not reported yet but were due before board time dark_s, when
    the gate was probably off. The budget counts every pulse that may have started before board time gate_off_s, when
    it is off for certain.
    """
    heat, state, zero_s = ended.heat_before, ended.budget_before, ended.plans[0].start_s
    for record in ended.plans:
        plan = record.plan
        heat, state = heat.copy_shifted(zero_s - record.start_s), shift_state(state, zero_s - record.start_s)
        zero_s = record.start_s
        kept_pulses = len(plan) - record.dropped
        if kept_pulses:
            until_s = min(gate_off_s - record.start_s, float(np.nextafter(plan.start_s[kept_pulses - 1], inf)))
            kept = PulsePlan(**{item.name: getattr(plan, item.name)[:kept_pulses] for item in fields(PulsePlan)})
            state = commit_until(kept, until_s, state, budget, on_progress)
        heat = _apply_emitted(heat, record, dark_s)
    return ThermalEstimate.from_plan(heat, state, zero_s)


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
    return ThermalEstimate.from_plan(plan.heat_before, plan.budget_before, plan.record.start_s)


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
