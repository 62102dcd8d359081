"""Ends of a sensor's range in noise or with a bend: a signal that becomes level as a function of the light's response.

Theory of operation

A converter's ceiling repeats one value. A sensor that saturates before its noise is added, or bends softly, does not.
But nothing in a pixel makes a signal level at one value in all runs, so the signal of all runs is fitted as one
function of the light's response with one bend. A level part above it or below it is the end of the range, but at zero:
the rest of a membrane with slack is level, too.
"""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.lab.inspection.response_faults import (
    INDEPENDENT,
    TEMPERATURE,
    compute_template,
    get_second_s,
    list_responding,
    measure_responses,
)
from optodrive.lab.inspection.work import Work, select_finite

BENDS = 0.5 - 0.5 * np.cos(np.linspace(0.35, 2.79, 24))
"""Places at which a signal becomes level, relative to the largest response."""
BEND_WIDTHS = (0.0, 0.045)
"""Widths of the bend, relative to the largest response."""
BEND_TAUS_S = np.geomspace(0.003, 0.1, 16)
"""Time constants of the response."""
REST_SHARE = 0.03
"""Share of the range of displacement or force within which a level part is the rest."""
BEND_MEANS = 60
"""Means of a run."""
BEND_PULSES = 12
"""Pulses of a run."""
MIN_BEND_RUNS = 3
"""Smallest number of runs."""
LEVEL_SLOPE = 0.2
"""Largest slope of the level part relative to the other."""
BEND_SIGMAS = 4.5
"""Significance of a bend."""
BEND_REACH = 3.0
"""Widths of the bend that are left out before it."""
BEND_ERROR = 0.02
"""Error of its place, relative to the largest response."""
OUTLYING = 10.0
"""Residual of a mean that holds an outlier, in medians of all."""
OWN_LEAVES = 1.3
"""Variance that bends of each run leave at least, relative to that left by a common one."""
_Means = tuple[FloatArray, FloatArray, int, FloatArray]


@dataclass(frozen=True, eq=False)
class _Bend:
    """Signals as a function of the light's response with one bend: residuals, slopes, significance, response."""

    residual: FloatArray
    below: float
    beyond: float
    sigmas: float
    x: FloatArray

    @property
    def left(self) -> float:
        """Rest of the variance."""
        return float(self.residual @ self.residual)


def find_saturation(work: Work, name: str) -> tuple[float, float, float] | None:
    """Return 1 for the highest value or −1 for the lowest, this value, and the reach of the bend before it, or None.

    The signal of all runs is one function of the light's response, which nothing in a pixel makes level at one value.
    """
    members = _list_means(work, name)
    if len(members) < MIN_BEND_RUNS:
        return None
    value = np.concatenate([mean for _, _, _, mean in members])
    kept = np.ones(len(value), dtype=np.bool_)
    size = np.abs(_fit_bend(members, name, value, kept, is_own=False).residual)
    # Outliers are sought after the ends of the range, and a few samples far off would turn the line that shows a bend.
    kept = size <= OUTLYING * np.median(size)
    value = value[kept]
    found = _fit_bend(members, name, value, kept, is_own=False)
    if min(found.below, found.beyond) > LEVEL_SLOPE * max(found.below, found.beyond) or found.sigmas < BEND_SIGMAS:
        return None
    is_high, excess, y = found.below > found.beyond, _bend(found.x), value - value.mean()
    if is_high and _fit_bend(members, name, value, kept, is_own=True).left < OWN_LEAVES * found.left:
        return None  # each run bends at a share of its own largest response, as where the light itself falls
    parts = found.x[:, None] - excess if is_high else excess
    centred = parts - parts.mean(axis=0)
    gains = y @ centred / (centred**2).sum(axis=0)
    at = int(np.argmax(gains * (y @ centred)))
    ends = value.mean() - gains * parts.mean(axis=0) + np.tile(BENDS, len(BEND_WIDTHS)) * gains * is_high
    if not is_high and name != TEMPERATURE and abs(ends[at]) < REST_SHARE * float(np.ptp(value)):
        return None  # the zero of displacement and force is their rest, at which a slack membrane is level, too
    reach = gains[at] * (BEND_REACH * np.repeat(BEND_WIDTHS, len(BENDS))[at] + BEND_ERROR)
    return (1.0 if is_high else -1.0), float(ends[at]), float(reach)


def _fit_bend(members: list[_Means], name: str, value: FloatArray, kept: BoolArray, *, is_own: bool) -> _Bend:
    """Return the best bend, at a value of all runs, or at a share of each run's own largest response.

    value: the means that are kept
    """
    y = value - value.mean()
    best = _Bend(y, 1.0, 1.0, 0.0, value)
    for tau_s in BEND_TAUS_S:
        templates = ((compute_template(pulses, t_s, tau_s, get_second_s(name)), n) for pulses, t_s, n, _ in members)
        own = [template.reshape(-1, size).mean(axis=1) for template, size in templates]
        x = np.concatenate(own)[kept]
        x /= max(float(x.max()), 1e-300)
        scale = np.concatenate([np.full(len(item), item.max()) for item in own])[kept] if is_own else np.ones(len(x))
        excess, line = scale[:, None] * _bend(x / scale), x - x.mean()
        slope, along = float(line @ y / (line @ line)), line @ excess / (line @ line)
        beside = excess - excess.mean(axis=0) - line[:, None] * along
        weight = np.maximum((beside**2).sum(axis=0), 1e-9)
        turns = y @ beside / weight
        at = int(np.argmax(turns**2 * weight))
        residual = y - slope * line - turns[at] * beside[:, at]
        left = float(residual @ residual)
        if left < best.left:
            below, error = slope - turns[at] * along[at], np.sqrt(INDEPENDENT * left / len(y) / weight[at])
            best = _Bend(residual, float(below), float(below + turns[at]), float(abs(turns[at]) / error), x)
    return best


def _bend(x: FloatArray) -> FloatArray:
    """Return by how much the response exceeds each bend [n, widths × bends]."""
    over = x[:, None] - BENDS
    exceeding = [width * np.logaddexp(0.0, over / width) if width else np.maximum(over, 0.0) for width in BEND_WIDTHS]
    return np.concatenate(exceeding, axis=1)


def _list_means(work: Work, name: str) -> list[_Means]:
    """Return pulses, times, samples in a mean, and means of the runs that respond, of the pixel measured most."""
    seen = [item.run for item in measure_responses(work, name) if item.is_seen]
    members = [item for item in list_responding(work, name) if item[0] in seen]
    pixels = [signal.pixel for _, signal, _, _, _ in members]
    out = []
    for _, signal, pulses, _, _ in members:
        t_s, value = select_finite(signal)
        end = int(np.searchsorted(t_s, pulses[BEND_PULSES, 0])) if len(pulses) > BEND_PULSES else len(t_s)
        size = max(end // BEND_MEANS, 1)
        end -= end % size
        if signal.pixel == max(pixels, key=pixels.count) and end:
            out.append((pulses[:BEND_PULSES], t_s[:end], size, value[:end].reshape(-1, size).mean(axis=1)))
    return out
