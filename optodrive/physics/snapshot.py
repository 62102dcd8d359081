"""A display of stepped pixels at one time after the other, each look going on from the one before. Kernels."""

from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.extended_pulses import DISPLACEMENT_SIGNAL, advance_states
from optodrive.physics.nominal_display import pixel_at
from optodrive.physics.pixel_ode import ActiveTerms, output_signal
from optodrive.physics.term import ABSORBER, ILLUMINATED_PIXEL, IS_TARGET, POWER_W


class SnapshotCache(NamedTuple):
    """How far each pixel was looked at: states [p, STATES] at at_s [p], reckoned from its event at from_s [p]."""

    at_s: FloatArray
    event_s: FloatArray
    states: FloatArray

    @classmethod
    def from_states(cls, states: FloatArray) -> "SnapshotCache":
        """A view of a display that was not looked at yet."""
        return cls(np.full(len(states), np.nan), np.full(len(states), np.nan), np.zeros_like(states))


@kernel
def compute_snapshot(
    columns: FloatArray,
    at_s: FloatArray,
    off_s: FloatArray,
    states: FloatArray,
    active: ActiveTerms,
    context: FloatArray,
    cache: SnapshotCache,
    now_s: float,
    displacement_m: FloatArray,
    absorber_k: FloatArray,
) -> None:
    """Fill in every pixel [p] at now_s, left dark since its last event, and note in the view how far it was followed.

    columns, at_s, dark_s, states: as `pulses.walk` has them.
    """
    room, c = np.zeros((8, states.shape[1])), context.copy()
    c[POWER_W], c[IS_TARGET] = 0.0, 1.0
    for i in range(len(at_s)):
        # A new event, or a look back: from the event on.
        if cache.event_s[i] != at_s[i] or now_s < cache.at_s[i]:
            cache.event_s[i] = cache.at_s[i] = at_s[i]
            cache.states[i] = states[i]
        one, wait_s = pixel_at(columns, i), max(0.0, now_s - cache.at_s[i])
        c[ILLUMINATED_PIXEL] = i
        room[0] = cache.states[i]
        advance_states(one, active, c, True, room, 0.0, off_s[i] + cache.at_s[i] - at_s[i], wait_s)
        cache.states[i] = room[0]
        cache.at_s[i] += wait_s
        displacement_m[i] = output_signal(one, active, room[0], c, DISPLACEMENT_SIGNAL)
        absorber_k[i] = room[0, ABSORBER]
