"""State of a display with terms at successive times, continued from the previous snapshot."""

from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import array_kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.physics.extended_pulses import (
    DISPLACEMENT_SIGNAL,
    EventStates,
    advance_states,
    copy_rows,
    copy_states,
    set_light,
)
from optodrive.physics.nominal_display import pixel_at
from optodrive.physics.pixel_ode import ActiveTerms, output_signal
from optodrive.physics.term import ABSORBER, PANEL_HELD, POWER_W


class SnapshotCache(NamedTuple):
    """States [p + 1, STATE_COUNT] of pixels and of laser and panel at at_s, computed from their events at event_s."""

    at_s: FloatArray
    event_s: FloatArray
    states: FloatArray

    @classmethod
    def from_events(cls, events: EventStates) -> "SnapshotCache":
        """Return an empty cache for the pixels of some events."""
        count = len(events.states)
        return cls(np.full(count, np.nan), np.full(count, np.nan), np.zeros((count, events.states.shape[1])))


@array_kernel
def compute_snapshot(
    events: EventStates,
    active: ActiveTerms,
    context: FloatArray,
    cache: SnapshotCache,
    now_s: float,
    displacement_m: FloatArray,
    absorber_k: FloatArray,
) -> None:
    """Fill in displacement and absorber rise of every pixel [p] at now_s, with the gate off since its last event.

    The cache is updated.
    """
    work, c, at_s = np.zeros((8, events.states.shape[1])), context.copy(), events.at_s
    c[POWER_W] = 0.0
    last = len(events.columns)
    for i in range(last, -1, -1):  # laser and panel come first: every pixel needs the panel
        # After a new event, or for an earlier time, the cached states are no start: begin at the event.
        if cache.event_s[i] != at_s[i] or now_s < cache.at_s[i]:
            cache.event_s[i] = cache.at_s[i] = at_s[i]
            copy_states(events.states[i], cache.states[i])
        one, wait_s = pixel_at(events.columns, i if i < last else 0), max(0.0, now_s - cache.at_s[i])
        set_light(c, i, events.illuminated[0])
        copy_states(cache.states[i], work[0])
        if i < last:
            copy_rows(active.panel_rows, cache.states[last], work[0])
        c[PANEL_HELD] = 1.0 if i < last else 0.0
        advance_states(one, active, c, work, 0.0, events.off_s[i] + cache.at_s[i] - at_s[i], wait_s)
        copy_states(work[0], cache.states[i])
        cache.at_s[i] += wait_s
        if i < last:
            displacement_m[i] = output_signal(one, active, work[0], c, DISPLACEMENT_SIGNAL)
            absorber_k[i] = work[0, ABSORBER]
