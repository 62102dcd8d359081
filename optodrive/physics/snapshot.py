"""A display of stepped pixels at one time after the other, each look going on from the one before. Kernels."""

from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.extended_pulses import DISPLACEMENT, carry
from optodrive.physics.nominal_display import one_pixel
from optodrive.physics.pixel_ode import Active, outputs
from optodrive.physics.term import ABSORBER, MINE, PIXEL, POWER_W


class View(NamedTuple):
    """How far each pixel was looked at: states [p, STATES] at at_s [p], reckoned from its event at from_s [p]."""

    at_s: FloatArray
    from_s: FloatArray
    states: FloatArray

    @classmethod
    def of(cls, states: FloatArray) -> "View":
        """A view of a display that was not looked at yet."""
        return cls(np.full(len(states), np.nan), np.full(len(states), np.nan), np.zeros_like(states))


@kernel
def glance(
    columns: FloatArray,
    at_s: FloatArray,
    dark_s: FloatArray,
    states: FloatArray,
    active: Active,
    context: FloatArray,
    view: View,
    now_s: float,
    height_m: FloatArray,
    absorber_k: FloatArray,
) -> None:
    """Fill in every pixel [p] at now_s, left dark since its last event, and note in the view how far it was followed.

    columns, at_s, dark_s, states: as `pulses.walk` has them.
    """
    room, c = np.zeros((8, states.shape[1])), context.copy()
    c[POWER_W], c[MINE] = 0.0, 1.0
    for i in range(len(at_s)):
        # A new event, or a look back: from the event on.
        if view.from_s[i] != at_s[i] or now_s < view.at_s[i]:
            view.from_s[i] = view.at_s[i] = at_s[i]
            view.states[i] = states[i]
        one, wait_s = one_pixel(columns, i), max(0.0, now_s - view.at_s[i])
        c[PIXEL] = i
        room[0] = view.states[i]
        carry(one, active, c, True, room, 0.0, dark_s[i] + view.at_s[i] - at_s[i], wait_s)
        view.states[i] = room[0]
        view.at_s[i] += wait_s
        height_m[i] = outputs(one, active, room[0], c, DISPLACEMENT)
        absorber_k[i] = room[0, ABSORBER]
