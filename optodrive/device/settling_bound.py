"""Upper bound of the settling time of a move, for every servo within its declared uncertainty.

Theory of operation. At a time τ after the end of its ramp, the mirror's error is the slew times the integral of h(ωt)
from τ to τ plus the ramp, where h is the error after a unit step. Its last crossing of the tolerance jumps where an
extremum just exceeds it, so neither corners nor a grid of servos bound it. The error itself changes slowly: h is at
most exp(−ζωt)/β with β = √(1 − ζ²), and so are its derivatives with polynomials of t, whose integrals from τ on bound
how much the error changes over a cell of parameters. If the ringing of the servo in the middle of a cell stays within a
tolerance that is narrower by that change, the ringing of every servo of the cell stays within the tolerance. Cells are
halved, that with the largest bound first, until the largest bound is near the longest settling time that was met. The
distance is a fourth parameter of the cells, so that one bound covers all moves between two distances.
"""

from cmath import exp as cexp
from functools import lru_cache
from math import exp, log, pi, sqrt

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.device.gate_timing import pole_per_s, ringing_s
from optodrive.device.servo import ServoRange

PRECISION = 0.002
"""Excess of the bound over the longest settling time that was met at which the search ends, relative."""
CELLS_MAX = 2000
"""Number of cells at which it ends in any case, with the bound that it has."""
DEPARTURE_STEPS = 40
OMEGA, DAMPING, SLEW, MOVE = range(4)
"""Parameters of a cell."""


@lru_cache(maxsize=1024)
def bound_settling_s(servos: ServoRange, min_move_rad: float, max_move_rad: float, tolerance_rad: float) -> float:
    """Return an upper bound of the settling times of all moves between two distances by any servo of the range, s.

    Like that of `settling_s`, it counts from the move's command. Distances and tolerance are positive.
    """
    low, high = servos.servo_at(-1.0, -1.0, -1.0, -1.0), servos.servo_at(1.0, 1.0, 1.0, 1.0)
    cells = np.empty((CELLS_MAX, 2, 4))
    cells[0, 0] = 2.0 * pi * low.frequency, low.damping, low.slew, min_move_rad
    cells[0, 1] = 2.0 * pi * high.frequency, high.damping, high.slew, max_move_rad
    # The delay only adds, so it needs no dimension of the box.
    return high.delay + _bound_s(cells, np.empty(CELLS_MAX), np.empty((CELLS_MAX, 4)), tolerance_rad)


def bound_departure_s(servos: ServoRange, tolerance_rad: float) -> float:
    """Return a lower bound of the time from a command until a mirror at rest has left a tolerance, s.

    While the error of a unit step falls, the fastest servo of the range leaves first: a higher frequency, a lower
    damping, and a ramp that is steeper, longer and earlier each move the mirror farther.
    """
    # The opposite corner of the box: here the fastest servo is the worst one.
    fast = servos.servo_at(1.0, -1.0, 1.0, -1.0)
    pole, rate = pole_per_s(fast), fast.damping / sqrt(1.0 - fast.damping**2)
    low_s, high_s = 0.0, pi / pole.imag
    for _ in range(DEPARTURE_STEPS):
        middle_s = 0.5 * (low_s + high_s)
        lag_s = ((1.0 - 1.0j * rate) * (cexp(pole * middle_s) - 1.0) / pole).real
        if fast.slew * (middle_s - lag_s) > tolerance_rad:
            high_s = middle_s
        else:
            low_s = middle_s
    # low_s was found to be within the tolerance, so it errs towards a shorter lead.
    return max(0.0, fast.delay) + low_s


@kernel
def _bound_s(cells: FloatArray, bounds_s: FloatArray, widths_s: FloatArray, tolerance_rad: float) -> float:
    """Return the bound over the first of the cells, without the delay, s. All arrays are overwritten.

    cells: [n, 2, 4] from low to high parameters; bounds_s: [n], of each cell
    widths_s: [n, 4], what each parameter adds to it
    """
    longest_s = 0.0
    # Corners first: they are no bound, but a long settling time that is met early ends the search early.
    for corner in range(16):
        omega, damping = cells[0, corner & 1, OMEGA], cells[0, (corner >> 1) & 1, DAMPING]
        slew, move_rad = cells[0, (corner >> 2) & 1, SLEW], cells[0, corner >> 3, MOVE]
        longest_s = max(longest_s, move_rad / slew + ringing_s(omega, damping, slew, move_rad / slew, tolerance_rad))
    _, bounds_s[0] = _bound_cell_s(cells[0, 0], cells[0, 1], tolerance_rad, widths_s[0])
    count = 1
    while True:
        largest = int(np.argmax(bounds_s[:count]))
        is_close = bounds_s[largest] <= (1.0 + PRECISION) * longest_s
        if is_close or count == len(bounds_s):
            # Also where the cells have run out: the bound is then wider, never wrong.
            return float(max(longest_s, bounds_s[largest]))
        # Halved where it adds most: four equal halvings would take sixteen cells per step.
        widest = int(np.argmax(widths_s[largest]))
        middle = 0.5 * (cells[largest, 0, widest] + cells[largest, 1, widest])
        for each in range(4):
            cells[count, 0, each], cells[count, 1, each] = cells[largest, 0, each], cells[largest, 1, each]
        cells[largest, 1, widest] = cells[count, 0, widest] = middle
        for half in (largest, count):
            met_s, bounds_s[half] = _bound_cell_s(cells[half, 0], cells[half, 1], tolerance_rad, widths_s[half])
            longest_s = max(longest_s, met_s)
        count += 1


@kernel
def _bound_cell_s(low: FloatArray, high: FloatArray, tolerance_rad: float, widths_s: FloatArray) -> tuple[float, float]:
    """Return the settling time in the middle of a cell, and a bound for the whole cell, without the delay, s.

    widths_s: [4], receives what the width of each parameter adds, by the error, as time of its decay, and by the ramp
    """
    omega, damping = 0.5 * (low[OMEGA] + high[OMEGA]), 0.5 * (low[DAMPING] + high[DAMPING])
    slew, move_rad = 0.5 * (low[SLEW] + high[SLEW]), 0.5 * (low[MOVE] + high[MOVE])
    ramp_s = move_rad / slew
    settled_s = ringing_s(omega, damping, slew, ramp_s, tolerance_rad)
    change_rad = _bound_changes_rad(low, high, tolerance_rad, settled_s, widths_s)
    for each in range(4):
        widths_s[each] /= tolerance_rad * damping * omega
    widths_s[SLEW] += high[MOVE] / low[SLEW] - high[MOVE] / high[SLEW]
    widths_s[MOVE] += (high[MOVE] - low[MOVE]) / low[SLEW]
    beta = sqrt(1.0 - high[DAMPING] ** 2)
    largest_rad = high[SLEW] / (low[OMEGA] * low[DAMPING] * beta)
    later_s = log(max(1.0, largest_rad / tolerance_rad)) / (low[DAMPING] * low[OMEGA])  # by the envelope alone
    if change_rad < tolerance_rad:
        # If the error changes by more than the tolerance over the cell, only its envelope bounds it.
        later_s = min(later_s, ringing_s(omega, damping, slew, ramp_s, tolerance_rad - change_rad))
    return ramp_s + settled_s, high[MOVE] / low[SLEW] + later_s


@kernel
def _bound_changes_rad(
    low: FloatArray, high: FloatArray, tolerance_rad: float, from_s: float, out: FloatArray
) -> float:
    """Return how much the error changes at most from the middle of a cell to any place in it, rad.

    from_s: time after the ramp from which on the error in the middle is within tolerance_rad, and the bound holds
    out: [4], receives the part of each parameter
    """
    damping, beta = low[DAMPING], sqrt(1.0 - high[DAMPING] ** 2)
    from_rad, ramp_rad = low[OMEGA] * from_s, high[OMEGA] * high[MOVE] / low[SLEW]
    # Of a slow servo the error is larger, of a fast one the same time lies later on the envelope.
    envelope = exp(-damping * from_rad) / beta
    scale_rad = high[SLEW] / low[OMEGA] * envelope
    # Integrals of the envelope and of its moment over a ramp, relative to the envelope at their start.
    area = min(1.0 / damping, ramp_rad)
    moment = min(from_rad / damping + 1.0 / damping**2, ramp_rad * (from_rad + ramp_rad))
    out[OMEGA] = scale_rad * moment * 0.5 * (high[OMEGA] - low[OMEGA]) / low[OMEGA]
    out[DAMPING] = scale_rad * (moment + area / beta) / beta * 0.5 * (high[DAMPING] - low[DAMPING])
    at_ramp_start = envelope * exp(-damping * low[OMEGA] * low[MOVE] / high[SLEW])
    out[MOVE] = at_ramp_start * 0.5 * (high[MOVE] - low[MOVE])
    # By the slew it changes by itself and what the ramp's start adds. It is below its envelope, and below the tolerance
    # and all changes over the cell. Of a short ramp both nearly cancel.
    half_width = 0.5 * (high[SLEW] - low[SLEW]) / low[SLEW]
    later_rad = half_width * high[MOVE] * at_ramp_start
    largest_rad = (tolerance_rad + out[OMEGA] + out[DAMPING] + out[MOVE] + later_rad) / (1.0 - half_width)
    out[SLEW] = min(
        later_rad + half_width * min(scale_rad * area, largest_rad), half_width * scale_rad * 0.5 * ramp_rad**2
    )
    return float(out[OMEGA] + out[DAMPING] + out[SLEW] + out[MOVE])
