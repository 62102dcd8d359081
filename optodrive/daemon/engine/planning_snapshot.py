"""State from which a plan is made: the plan's zero, and heat and budget at that time."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import BoolArray
from optodrive.core.types.plans import BudgetState
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate
from optodrive.link.protocol.point_cut import PointCut
from optodrive.physics.thermal_state import ThermalState
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import commit_until, shift_state


@dataclass(frozen=True, eq=False)
class PlanningSnapshot:
    """Initial state of a plan.

    thermal: estimate from which the snapshot was derived; the snapshot is stale once the queue has another one
    start_s: board time of the plan's zero
    heat, budget: state at that time, on the plan's own time line
    predecessor, cut: running plan that the new one truncates, and where
    initial_pixels: pixel at which the mirrors of each stage point at the plan's zero; None if one is unknown
    refreshed: [p] pixels that the current refresh cycle of a stream has drawn
    """

    thermal: ThermalEstimate
    start_s: float
    heat: ThermalState
    budget: BudgetState
    predecessor: ActivePlan | None = None
    cut: PointCut | None = None
    initial_pixels: tuple[int, ...] | None = None
    refreshed: BoolArray | None = None


class RefreshCycle(NamedTuple):
    """Progress of a stream's refresh cycle when the stream was truncated.

    The cycle continues only if `thermal` is still the queue's estimate, that is, if no other plan came in between.
    """

    thermal: ThermalEstimate
    refreshed: BoolArray


def build_cut_snapshot(
    running: ActivePlan, thermal: ThermalEstimate, min_start_s: float, budget: Budget, tick_s: float
) -> PlanningSnapshot | None:
    """Build the snapshot for truncating a running plan before its first point after board time min_start_s.

    Return None if no pulse would be left, or none would be dropped.
    """
    plan, zero_s = running.planned.plan, running.record.start_s
    cut = PointCut.find(running.points, (min_start_s - zero_s - running.zero_s) / tick_s)
    if not 0 < cut.row < len(plan):
        return None
    end_s = running.zero_s + cut.end_tick * tick_s
    kept = slice(cut.row)
    heat = running.heat_before.copy()
    heat.apply_pulses(plan.pixel[kept], plan.start_s[kept], plan.width_s[kept], plan.power_w[kept])
    state = commit_until(plan, float(plan.start_s[cut.row]), running.budget_before, budget)
    pairs = zip(cut.aim_rows, running.points.stages, strict=True)
    is_aim_unknown = any(row == -1 and len(points) for row, points in pairs)  # a lost stage has no points
    return PlanningSnapshot(
        thermal=thermal,
        start_s=zero_s + end_s,
        heat=heat.copy_shifted(-end_s),
        budget=shift_state(state, -end_s),
        predecessor=running,
        cut=cut,
        initial_pixels=None if is_aim_unknown else tuple(plan.pixel[cut.aim_rows].tolist()),
        refreshed=mark_refreshed(running, cut.row),
    )


def mark_refreshed(truncated: ActivePlan, cut_row: int) -> BoolArray:
    """Return the pixels that a refresh cycle has drawn when its plan is truncated, [p].

    All pixels are unmarked if what is left contains no pixel that is still to be drawn: a new cycle starts.
    """
    pixel = truncated.planned.plan.pixel
    if truncated.refreshed is None:
        refreshed = np.zeros(len(truncated.heat_before.pixels), dtype=np.bool_)
    else:
        refreshed = truncated.refreshed.copy()
    refreshed[pixel[:cut_row]] = True
    left = np.concatenate([pixel[cut_row:], truncated.unplanned_pixels])
    return refreshed if not refreshed[left].all() else np.zeros_like(refreshed)
