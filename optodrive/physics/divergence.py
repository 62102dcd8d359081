"""Errors of a pixel whose integration has diverged, with the term at fault."""

import numpy as np

from optodrive.core.errors import DivergedError, Unquoted
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.term import ABSORBER, FIRST_FOLLOWER, GAS, NEIGHBOUR, WALL
from optodrive.physics.term_kernels import FOLLOWER_ROW, TERMS

MAX_STATE = 1e6
"""Largest magnitude of a state; a larger one has diverged."""
SHARED_STATES = {ABSORBER: "absorber", GAS: "gas", NEIGHBOUR: "neighbour", WALL: "wall"}
SIGNAL_NAMES = ("temperature", "displacement", "force")


def build_state_error(active: list[int], rows: list[int], state: FloatArray) -> DivergedError:
    """Return the error that names a state outside of its range, and its term.

    active: rows of the active terms; rows: those of the states that move; state: [STATE_COUNT]
    """
    row = max(row for row in rows if not abs(state[row]) <= MAX_STATE)  # a term's states take the shared ones along
    term, name = _describe_terms(active), SHARED_STATES.get(row, "")
    if row >= FIRST_FOLLOWER:
        owner = max(number for number, first in enumerate(FOLLOWER_ROW) if first <= row and TERMS[number].followers)
        term, name = f"term {TERMS[owner].key}", TERMS[owner].followers[row - FOLLOWER_ROW[owner]]
    expected = f"at most ±{MAX_STATE:g}: a term's states need time constants of 2.5 ms or more"
    return DivergedError(term, Unquoted(f"{state[row]:g} as state '{name}'"), expected)


def build_signal_error(active: list[int], signals: tuple[FloatArray, ...]) -> DivergedError:
    """Return the error that names a signal that is no number.

    active: rows of the active terms
    """
    name = next(name for name, signal in zip(SIGNAL_NAMES, signals, strict=True) if not np.isfinite(signal).all())
    return DivergedError(_describe_terms(active), Unquoted(f"a {name} that is no number"), "finite signals")


def _describe_terms(active: list[int]) -> str:
    keys = ", ".join(TERMS[row].key for row in active)
    return f"term{'s' if len(active) > 1 else ''} {keys}" if active else "the pixel"
