"""What the display does when pulses are executed: exact traces of the pixels that are looked at."""

import numpy as np

from optodrive.flow import ExecutedPulses, PixelTrace
from optodrive.physics.array import DisplayHeat, pixel_trace
from optodrive.physics.parameters import PixelArray

AFTERGLOW_S = 0.2
"""A trace goes on this long after the last pulse."""


def trace(pixels: PixelArray, executed: ExecutedPulses, looked_at: list[int], dt_s: float) -> PixelTrace:
    """Traces from rest, sampled every dt_s from the plan's zero to a while after the last pulse."""
    end_s = float(executed.start_s[-1] + executed.width_s[-1]) if len(executed) else 0.0
    t_s = np.arange(0.0, end_s + AFTERGLOW_S, dt_s)
    columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    pulses = zip(*(column.tolist() for column in columns), strict=True)
    return pixel_trace(DisplayHeat(pixels), pulses, looked_at, t_s)
