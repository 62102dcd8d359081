"""Exact traces of selected pixels of the display under executed pulses."""

import numpy as np

from optodrive.core.types.measurements import PixelTrace
from optodrive.core.types.plans import ExecutedPulses
from optodrive.physics.thermal_state import ThermalState

TRACE_TAIL_S = 0.2
"""Duration of a trace after the last pulse."""
TRACE_LEAD_S = 0.02
"""Duration of a pixel's trace before its first pulse."""


def compute_traces(cold_state: ThermalState, executed: ExecutedPulses, pixels: list[int], dt_s: float) -> PixelTrace:
    """Compute the traces of pixels from the cold state, every dt_s until a fixed tail after the plan."""
    end_s = float(executed.start_s[-1] + executed.width_s[-1]) if len(executed) else 0.0
    t_s = np.arange(0.0, end_s + TRACE_TAIL_S, dt_s)
    pulses = np.column_stack([executed.start_s, executed.width_s, executed.power_w, executed.pixel])
    return cold_state.simulate_traces(pulses, pixels, t_s)


def compute_pixel_trace(
    cold_state: ThermalState, executed: ExecutedPulses, pixel: int, dt_s: float, after_s: float
) -> PixelTrace:
    """Compute one pixel's trace from the cold state, every dt_s until after_s after its last pulse."""
    is_pixel = executed.pixel == pixel
    if not is_pixel.any():
        return cold_state.simulate_traces(np.zeros((0, 4)), [pixel], np.arange(0.0, after_s, dt_s))
    first_s = max(0.0, float(executed.start_s[is_pixel][0]) - TRACE_LEAD_S)
    last_s = float((executed.start_s + executed.width_s)[is_pixel][-1]) + after_s
    pulses = np.column_stack([executed.start_s, executed.width_s, executed.power_w, executed.pixel])
    return cold_state.simulate_traces(pulses, [pixel], np.arange(first_s, last_s, dt_s))
