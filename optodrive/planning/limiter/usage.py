"""How much of each cap is in use at a moment, by the limiter's own bound."""

from typing import NamedTuple

from optodrive.core.types.plans import BudgetState
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.cap_checks import compute_levels
from optodrive.planning.limiter.caps import CAP_NUMBERS, CAPS
from optodrive.planning.limiter.heat_bound import panel_peak_k


class Usage(NamedTuple):
    """Use of one cap, in the unit of its `CapValues` field.

    pixel: the one with the highest use, None per display
    """

    cap: str
    used: float
    limit: float
    pixel: int | None


def compute_usage(state: BudgetState, budget: Budget, at_s: float) -> tuple[Usage, ...]:
    """Return the use of every gauged cap at `at_s`, on the state's time line, with the gate off since the state."""
    levels = compute_levels(state, budget, at_s)
    usages = []
    for cap in CAPS:
        if cap.is_gauged:
            level = levels[CAP_NUMBERS[cap.key]]
            pixel = int(level.argmax()) if cap.is_per_pixel else None
            usages.append(Usage(cap.key, float(level.max()), getattr(budget.caps, cap.field), pixel))
    return tuple(usages)


def compute_panel_k(state: BudgetState, budget: Budget, at_s: float) -> float:
    """Return the bound on the panel's rise at `at_s`, K, with the gate off since the state, or zero without a panel."""
    return float(panel_peak_k(budget.heat, state.panel_k, at_s - state.panel_at_s, 0.0))
