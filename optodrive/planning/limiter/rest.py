"""Rows of a limited plan from one on, replaced or later."""

from dataclasses import fields, replace

from optodrive.core.types.plans import BudgetState, LimitedPlan
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import concatenate


def replace_rest(
    plan: LimitedPlan, first_row: int, rest: LimitedPlan, shift_s: float, state: BudgetState, budget: Budget
) -> LimitedPlan:
    """Return the plan with other rows from first_row on, each shift_s later. state: after the rest."""
    parts = [_slice_rows(plan, slice(first_row), 0.0), _slice_rows(rest, slice(None), shift_s)]
    return concatenate(parts, state, budget)


def delay_rest(plan: LimitedPlan, first_row: int, delay_s: float) -> LimitedPlan:
    """Return the plan with its rows from first_row on delay_s later."""
    start_s = plan.start_s.copy()
    start_s[first_row:] += delay_s
    return replace(plan, start_s=start_s)


def _slice_rows(plan: LimitedPlan, rows: slice, shift_s: float) -> LimitedPlan:
    columns = {item.name: getattr(plan, item.name)[rows] for item in fields(LimitedPlan) if item.name != "headroom_k"}
    columns["start_s"] = columns["start_s"] + shift_s
    return LimitedPlan(**columns, headroom_k=plan.headroom_k)
