"""Check that the integrator's steps are short enough for the states of terms."""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from optodrive.core.errors import DivergedError, Unquoted
from optodrive.core.quantity import format_quantity
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, evaluate_rates, next_step_s
from optodrive.physics.term import (
    ABSORBER,
    AMBIENT_K,
    CONTEXT_SIZE,
    DOSE,
    FULL_W,
    GAS,
    IS_TARGET,
    POWER_W,
    SINCE_EDGE_S,
    TIME_S,
    TermValues,
)
from optodrive.physics.term_kernels import FOLLOWER_ROW, STATE_COUNT, TERM_ROW
from optodrive.physics.terms import all_terms

STABLE_STEP = 2.78
"""Longest stable step of the classical Runge–Kutta method, in time constants."""
SLOW_PIXEL = Pixel(184.0, 126e-6, 0.66, 2e-2, 4e-6, 2.3e-4)
"""A pixel whose gas is so slow that the steps become as long as they can be."""
# Late first: steps are longest there, so most faults end the check at once.
CHECKED_AFTER_S = (0.1, 1e-3, 0.0)
"""Times after a gate edge at which a step is checked; the first one is followed by the longest step."""
HOT_K = 300.0
CHANGE = 1e-3
"""Change of a state for finite differences."""


def check_time_constants(values: Mapping[str, TermValues]) -> None:
    """Raise DivergedError if a term has a time constant that is too short for the steps.

    values: term → parameter → SI value

    They are the inverse eigenvalues of the Jacobian of the term's own states, on a hot pixel in the light.
    """
    for key, term_values in values.items():
        # Terms without states of their own have nothing that could be too fast.
        if all_terms()[key].states or all_terms()[key].followers:
            requirements = {name: values.get(name, {}) for name in all_terms()[key].requires}
            every = {key: term_values, **requirements}
            _check_term(key, tuple((name, tuple(sorted(item.items()))) for name, item in every.items()))


@lru_cache(maxsize=1024)
def _check_term(key: str, frozen: tuple[tuple[str, tuple[tuple[str, float], ...]], ...]) -> None:
    active = ActiveTerms.from_values({name: dict(items) for name, items in frozen})
    term, first = all_terms()[key], FOLLOWER_ROW[TERM_ROW[key]]
    rows = [*term.states, *range(first, first + len(term.followers))]
    context, state = np.zeros(CONTEXT_SIZE), np.zeros(STATE_COUNT)
    context[POWER_W] = context[FULL_W] = 2.45
    context[AMBIENT_K], context[DOSE], context[IS_TARGET] = 293.15, 1.0, 1.0
    state[ABSORBER], state[GAS] = HOT_K, 0.5 * HOT_K
    for after_s in CHECKED_AFTER_S:
        context[TIME_S] = context[SINCE_EDGE_S] = after_s
        fastest_per_s = float(np.abs(np.linalg.eigvals(_compute_jacobian(active, context, state, rows))).max())
        step_s = next_step_s(SLOW_PIXEL, active, after_s)
        if not fastest_per_s * step_s <= STABLE_STEP:
            shortest, found = (format_quantity(item, "s", 2) for item in (step_s / STABLE_STEP, 1.0 / fastest_per_s))
            expected = f"{shortest} or more, {format_quantity(after_s, 's')} after an edge of the gate"
            raise DivergedError(f"term {key}", Unquoted(f"a time constant of {found}"), expected)


def _compute_jacobian(active: ActiveTerms, context: FloatArray, state: FloatArray, rows: list[int]) -> FloatArray:
    """Return the derivatives [k, k] of the rates of some states with respect to these."""
    rates = np.zeros((1 + len(rows), STATE_COUNT))
    evaluate_rates(SLOW_PIXEL, active, state, context, rates[0])
    for number, row in enumerate(rows, start=1):
        changed = state.copy()
        # Finite differences: kernels may hold any expression.
        changed[row] += CHANGE
        evaluate_rates(SLOW_PIXEL, active, changed, context, rates[number])
    return np.asarray(((rates[1:] - rates[0])[:, rows] / CHANGE).T)
