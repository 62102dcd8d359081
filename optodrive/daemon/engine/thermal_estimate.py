"""Thermal state and budget state on the board's time line, as estimated by the daemon."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from math import inf
from typing import NamedTuple, Self

import numpy as np

from optodrive.core.types.arrays import IntArray
from optodrive.core.types.plans import BudgetState, ExecutedPulses, PulsePlan
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.physics.thermal_state import ThermalState
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
