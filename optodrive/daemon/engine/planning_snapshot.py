"""State from which a plan is made: the plan's zero, and heat and budget at that time."""

from dataclasses import dataclass
from math import inf, nan

import numpy as np

from optodrive.core.types.plans import BudgetState
from optodrive.daemon.engine.active_plan import ActivePlan, RefreshCycle
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate
from optodrive.link.protocol.stage_points import PointCut
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
    cycle: when the stream has drawn each pixel last, None if no stream was before
    pause_s: time of the plan before which a frame is not drawn, so that frames keep the rhythm in which they arrive
    """

    thermal: ThermalEstimate
    start_s: float
    heat: ThermalState
    budget: BudgetState
    predecessor: ActivePlan | None = None
    cut: PointCut | None = None
    initial_pixels: tuple[int, ...] | None = None
    cycle: RefreshCycle | None = None
    pause_s: float = 0.0


def build_cut_snapshot(
    running: ActivePlan,
    thermal: ThermalEstimate,
    min_start_s: float,
    budget: Budget,
    tick_s: float,
    may_withdraw: bool = False,
    min_end_s: float = inf,
    begin_s: float = -inf,
) -> PlanningSnapshot | None:
    """Build the snapshot for truncating a running plan before its first point after board time min_start_s.

    may_withdraw: whether no point of the plan must be left
    min_end_s: board time at which the plan may end for another to follow it if nothing of it can be dropped; that one
    then begins at begin_s
    Return None if no pulse would be left of a plan that must keep one, or none would be dropped and it ends too early.
    """
    plan, zero_s = running.planned.plan, running.record.start_s
    min_tick = (min_start_s - zero_s - running.zero_s) / tick_s
    cut = PointCut.find(running.points, min_tick if may_withdraw else max(1.0, min_tick))
    end_s = running.zero_s + cut.end_tick * tick_s
    is_whole = cut.row == len(plan)
    if (is_whole and zero_s + end_s < min_end_s) or (not cut.row and any(cut.kept_points)):
        return None
    kept = slice(cut.row)
    heat = running.heat_before.copy()
    heat.apply_pulses(plan.pixel[kept], plan.start_s[kept], plan.width_s[kept], plan.power_w[kept])
    until_s = inf if is_whole else float(plan.start_s[cut.row])
    state = commit_until(plan, until_s, running.budget_before, budget)
    return PlanningSnapshot(
        thermal=thermal,
        start_s=zero_s + end_s,
        heat=heat.copy_shifted(-end_s),
        budget=shift_state(state, -end_s),
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
        pixels = len(streamed.heat_before.pixels)
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
