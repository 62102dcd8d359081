"""State from which a plan is made: the plan's zero, and heat and budget at that time."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray
from optodrive.core.types.plans import BudgetState
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import commit_until, shift_state


@dataclass(frozen=True, eq=False)
class PlanningSnapshot:
    """Initial state of a plan.

    thermal: estimate from which the snapshot was derived; the snapshot is stale once the queue has another one
    start_s: board time of the plan's zero
    heat, budget: state at that time, on the plan's own time line
    predecessor, cut_row: running plan that the new one truncates, and the first row that it drops
    initial_pixel: pixel at which the mirrors point at the plan's zero
    refreshed: [p] pixels that the current refresh cycle of a stream has drawn
    """

    thermal: ThermalEstimate
    start_s: float
    heat: ThermalState
    budget: BudgetState
    predecessor: ActivePlan | None = None
    cut_row: int = 0
    initial_pixel: int | None = None
    refreshed: BoolArray | None = None


class RefreshCycle(NamedTuple):
    """Progress of a stream's refresh cycle when the stream was truncated.

    The cycle continues only if `thermal` is still the queue's estimate, that is, if no other plan came in between.
    """

    thermal: ThermalEstimate
    refreshed: BoolArray


def build_cut_snapshot(
    running: ActivePlan, thermal: ThermalEstimate, min_start_s: float, budget: Budget
) -> PlanningSnapshot | None:
    """Build the snapshot for truncating a running plan before its first point after board time min_start_s.

    Return None if no pulse would be left, or none would be dropped.
    """
    plan, zero_s = running.planned.plan, running.record.start_s
    # A pulse's point begins at the end of the pulse before it, and may hold a long pause of the mirrors.
    cut_row = 1 + int(np.searchsorted(plan.start_s + plan.width_s, min_start_s - zero_s))
    # The mirrors point at the last pulse's pixel only if that pulse emits.
    while 0 < cut_row < len(plan) and plan.power_w[cut_row - 1] == 0.0:
        cut_row += 1
    if not 0 < cut_row < len(plan):
        return None
    end_s = float(plan.start_s[cut_row - 1] + plan.width_s[cut_row - 1])
    heat = running.heat_before.copy()
    heat.apply_pulses(plan.pixel[:cut_row], plan.start_s[:cut_row], plan.width_s[:cut_row], plan.power_w[:cut_row])
    state = commit_until(plan, float(plan.start_s[cut_row]), running.budget_before, budget)
    return PlanningSnapshot(
        thermal=thermal,
        start_s=zero_s + end_s,
        heat=heat.copy_shifted(-end_s),
        budget=shift_state(state, -end_s),
        predecessor=running,
        cut_row=cut_row,
        initial_pixel=int(plan.pixel[cut_row - 1]),
        refreshed=mark_refreshed(running, cut_row),
    )


def mark_refreshed(truncated: ActivePlan, cut_row: int) -> BoolArray:
    """Return the pixels that a refresh cycle has drawn when its plan is truncated, [p].

    All pixels are unmarked if the dropped pulses contain no pixel that is still to be drawn: a new cycle starts.
    """
    pixel = truncated.planned.plan.pixel
    if truncated.refreshed is None:
        refreshed = np.zeros(len(truncated.heat_before.pixels), dtype=np.bool_)
    else:
        refreshed = truncated.refreshed.copy()
    refreshed[pixel[:cut_row]] = True
    return refreshed if not refreshed[pixel[cut_row:]].all() else np.zeros_like(refreshed)
