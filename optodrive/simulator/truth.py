"""What the display does when pulses are executed: exact traces of the pixels that are looked at."""

import numpy as np

from optodrive.flow import ExecutedPulses, PixelTrace
from optodrive.physics.heat import Heat

AFTERGLOW_S = 0.2
"""A trace goes on this long after the last pulse."""


def trace(at_rest: Heat, executed: ExecutedPulses, looked_at: list[int], dt_s: float) -> PixelTrace:
    """Traces from rest, sampled every dt_s from the plan's zero to a while after the last pulse."""
    end_s = float(executed.start_s[-1] + executed.width_s[-1]) if len(executed) else 0.0
    t_s = np.arange(0.0, end_s + AFTERGLOW_S, dt_s)
    pulses = np.column_stack([executed.start_s, executed.width_s, executed.power_w, executed.pixel])
    return at_rest.traces(pulses, looked_at, t_s)
