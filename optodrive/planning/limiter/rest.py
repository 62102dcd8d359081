"""Limit the rest of a limited plan again, after an interruption and from another budget state."""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np

from optodrive.core.types.plans import BudgetState, LimitedPlan, PulsePlan
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import CHUNK_PULSES, concatenate, limit


def limit_rest(
    plan: LimitedPlan,
    first_row: int,
    shift_s: float,
    state: BudgetState,
    budget: Budget,
    on_progress: Callable[[], None],
) -> tuple[LimitedPlan, BudgetState]:
    """Limit the rows of a plan from first_row on, each shift_s later, and return them with the state after them.

    No pulse has more power than before. Shifted times and state.at_s are on the same time line. The energy that was
    removed, and its reason, include those of the plan.
    """
    old = _slice_rows(plan, slice(first_row, None), shift_s)
    limited = []
    for begin in range(0, len(old), CHUNK_PULSES):
        rows = slice(begin, begin + CHUNK_PULSES)
        columns = {item.name: getattr(old, item.name)[rows] for item in fields(PulsePlan)}
        chunk, state = limit(PulsePlan(**columns), state, budget)
        limited.append(chunk)
        on_progress()
    rest = concatenate(limited, state, budget)
    # A row that was trimmed before keeps its reason: its power is still the lower one.
    reason = np.where(rest.reason != "", rest.reason, old.reason)
    return replace(rest, trimmed_j=old.trimmed_j + rest.trimmed_j, reason=reason), state


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
