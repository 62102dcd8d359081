"""Linear filters of sampled signals, exact for signals that are linear between samples."""

from math import exp

import numpy as np

from optodrive.core.kernels import array_kernel
from optodrive.core.types.arrays import FloatArray


@array_kernel
def _relax(t_s: FloatArray, value: FloatArray, tau_s: float, out: FloatArray) -> None:
    out[0] = value[0]
    for row in range(1, len(value)):
        h_s = t_s[row] - t_s[row - 1]
        kept = exp(-h_s / tau_s)
        slope = (value[row] - value[row - 1]) / h_s
        lag = slope * tau_s  # of the answer behind a ramp, once it follows
        out[row] = value[row] - lag + (out[row - 1] - value[row - 1] + lag) * kept


def low_pass(t_s: FloatArray, value: FloatArray, tau_s: float) -> FloatArray:
    """Return a signal [n] behind a low-pass of first order that had settled at its first sample.

    t_s: [n], strictly increasing
    """
    out = np.empty(len(value))
    if len(value):
        _relax(np.ascontiguousarray(t_s), np.ascontiguousarray(value), tau_s, out)
    return out


def low_pass_both_ways(t_s: FloatArray, value: FloatArray, tau_s: float) -> FloatArray:
    """Return a signal [n] filtered forwards and backwards, as no instrument but a program does."""
    return low_pass(-t_s[::-1], low_pass(t_s, value, tau_s)[::-1], tau_s)[::-1]


def moving_mean(t_s: FloatArray, value: FloatArray, width_s: float, late_s: float = 0.0) -> FloatArray:
    """Return the mean [n] over width_s around late_s before each sample, or over the part that the signal covers."""
    if len(value) < 2:
        return value
    steps = np.diff(t_s)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (value[1:] + value[:-1]) * steps)])
    ends = [np.clip(t_s - late_s + side * 0.5 * width_s, t_s[0], t_s[-1]) for side in (-1.0, 1.0)]
    before, after = (_integrate_to(t_s, value, total, end) for end in ends)
    covered_s = ends[1] - ends[0]
    return np.where(covered_s > 1e-12, (after - before) / np.maximum(covered_s, 1e-12), value[0])


def _integrate_to(t_s: FloatArray, value: FloatArray, total: FloatArray, end_s: FloatArray) -> FloatArray:
    """Return the integral from the first sample to each time.

    total: the same to each sample
    """
    row = np.clip(np.searchsorted(t_s, end_s, side="right") - 1, 0, len(t_s) - 2)
    share = (end_s - t_s[row]) / (t_s[row + 1] - t_s[row])
    last = value[row] + share * (value[row + 1] - value[row])
    return np.asarray(total[row] + 0.5 * (value[row] + last) * (end_s - t_s[row]))
