"""Faults in the samples of one signal of one run.

Theory of operation

Every test compares samples with others of the same signal, so none needs a model of the pixel. Where a smooth signal
without noise, or a coarse converter, would look like the fault, the test asks for what these cannot show: a ceiling is
reached without slowing down; held samples change at equal intervals and by more than the converter's step; interpolated
ones have no curvature but at equal intervals; an outlier deviates from what its neighbours on the left predict, from
what those on the right predict, and more than these neighbours do from a smooth curve.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray
from optodrive.lab.inference.noise import estimate_noise

THIRDS = (3,)
"""Order of the differences by which noise is estimated."""
MIN_QUANTA = 8
"""Smallest number of steps between levels by which a converter's step is found."""
ROUNDING = 1e-6
"""Rounding error of a value, relative."""
SENTINELS = (999.0, 999.9, 9999.0, 99999.0, 32767.0, 32768.0, 65535.0, 2147483647.0, 1e30, 9.9e37, 9.91e37, 1e38)
"""Magnitudes that programs write in place of a missing value, beside float32's largest and 0 K."""
LARGEST_FLOAT32 = float(np.finfo(np.float32).max)
SENTINEL_GAP = 0.2
"""Distance of a repeated impossible value from all others, relative to their range."""
SENTINEL_SHARE = 0.5
"""Largest share of such values."""
MIN_STUCK = 20
"""Smallest number of equal samples in a row that are stuck."""
STUCK_TIES = 0.2
"""Largest share of equal neighbours among the others."""
MIN_TIES = 5
"""Equal samples at a ceiling."""
PILE = 2.0
"""The same relative to those at each of the next levels of a converter."""
NEXT_LEVELS = 5
"""Number of these levels."""
CEILING_SIGMAS = 4.0
"""σ below a ceiling that are left out too."""
APPROACH = 0.02
"""Bands below a ceiling in which the last approach is timed, relative to the range."""
TURN_STEPS = 4.0
"""Steps of a converter below a ceiling over which rounding does not matter."""
TURN = 5.0
"""Time at a ceiling, relative to the time for these steps."""
RISE = 0.5
"""Rise before it, relative to the range."""
MIN_RISE = 4
"""Smallest number of samples of this rise."""
HOLD_SHARE = 0.45
"""Smallest share of equal neighbours of held samples."""
HOLD_BLOCKS = 8
"""Smallest number of blocks of held samples."""
FEW_BLOCKS = 4
"""Smallest number of blocks of at least `LONG_BLOCK` samples."""
LONG_BLOCK = 5.0
"""Samples of a long block."""
HOLD_REGULAR = 0.97
"""Smallest share of blocks at regular intervals."""
HOLD_STEPS = 0.3
"""Smallest share of steps between blocks above the quantum."""
COLLINEAR_SHARE = 0.5
"""Smallest share of interpolated samples without curvature."""
MIN_SEGMENTS = 8
"""Smallest number of straight parts."""
MIN_SEGMENT = 3
"""Smallest number of samples in each."""
OUTLIER_SIGMAS = 6.0
"""Smallest deviation of an outlier."""
SMOOTH_SIGMAS = 12.0
"""The same in a signal that was smoothed."""
SIDE = 5
"""Samples on either side that predict it."""
MAX_WIDTH = 3
"""Largest number of samples of an outlier."""
ROUGHNESS = 6.0
"""Ratio to the deviations of its neighbours."""
Slow = tuple[float, FloatArray, FloatArray] | None
"""Interval of a slower channel, s, and its own times and values."""


@dataclass(frozen=True)
class SampleNoise:
    """Noise between neighbouring samples.

    sigma: robust; is_rough: whether neighbours differ as noise does, rather than as a smooth signal; quantum: step of
    which all values are multiples, 0 if there is none
    """

    sigma: float
    is_rough: bool
    quantum: float


def measure_noise(value: FloatArray) -> SampleNoise:
    """Return the noise of samples in order of time."""
    if len(value) < 16:
        return SampleNoise(0.0, False, 0.0)
    near, far = (estimate_noise([value], THIRDS, stride=stride) for stride in (1, 2))
    return SampleNoise(near, near > 0.5 * far and near > 1e-9 * float(np.abs(value).max()), find_quantum(value, 1))


def find_quantum(value: FloatArray, min_quanta: int = MIN_QUANTA) -> float:
    """Return the step of which all values are multiples, or 0 if there is none, or too few levels."""
    levels = np.unique(value)
    steps = np.diff(levels)
    steps = steps[steps > ROUNDING * float(np.abs(levels).max())]
    if len(steps) < min_quanta:
        return 0.0
    count = (levels - levels[0]) / steps.min()
    return float(steps.min()) if float(np.abs(count - np.round(count)).max()) < 0.05 else 0.0


def find_sentinels(value: FloatArray, low: float, high: float) -> BoolArray:
    """Return which samples stand for a missing value.

    low, high: limits of what is possible
    """
    is_impossible = (value <= low) | (value >= high)
    magnitude = np.abs(value)
    is_known = np.zeros(len(value), dtype=bool)
    for sentinel in (*SENTINELS, LARGEST_FLOAT32):
        is_known |= np.abs(magnitude - sentinel) <= 1e-6 * sentinel
    _levels, inverse, counts = np.unique(value, return_inverse=True, return_counts=True)
    is_repeated = counts[inverse] > 1
    candidates = (is_impossible & (is_known | is_repeated | (value == 0.0))) | is_known
    if not candidates.any() or candidates.mean() > SENTINEL_SHARE:
        return np.zeros(len(value), dtype=bool)
    rest = value[~candidates]
    distance = np.where(value > rest.max(), value - rest.max(), np.where(value < rest.min(), rest.min() - value, 0.0))
    # Possible values are sentinels only where the signal is nowhere near them.
    return np.asarray(candidates & (is_impossible | (distance > SENTINEL_GAP * float(np.ptp(rest)))))


def find_stuck(value: FloatArray) -> BoolArray:
    """Return which samples belong to a long row of equal ones in a signal whose neighbours differ otherwise.

    Rows at the largest or the smallest value are left to the search for a ceiling.
    """
    starts, lengths = _find_rows(value)
    is_long = (lengths >= MIN_STUCK) & (value[starts] != value.max()) & (value[starts] != value.min())
    is_stuck = np.repeat(is_long, lengths)
    if not is_long.any():
        return is_stuck
    others, noise = lengths[lengths < MIN_STUCK], measure_noise(value[~np.repeat(lengths >= MIN_STUCK, lengths)])
    ties = 1.0 - len(others) / max(int(others.sum()), 1)
    is_noisy = noise.is_rough and noise.sigma > noise.quantum and ties <= STUCK_TIES
    return is_stuck if is_noisy else np.zeros(len(value), dtype=bool)


def _find_rows(value: FloatArray) -> tuple[IntArray, IntArray]:
    """Return first samples and lengths of the rows of equal samples."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(value) != 0.0) + 1])
    return starts, np.diff(np.append(starts, len(value)))


def find_ceiling(t_s: FloatArray, value: FloatArray, may_be_smooth: bool) -> float | None:
    """Return the value at which samples pile up at the top, or None.

    may_be_smooth: whether a ceiling is sought without noise too, where a signal at rest ends in equal samples as well
    """
    if len(value) < 4 * MIN_TIES:
        return None
    top = float(value.max())
    is_tie = value >= top - 1e-12 * abs(top)
    noise = measure_noise(value[~is_tie])
    if is_tie.sum() < MIN_TIES or is_tie.all():
        return None
    if noise.is_rough and noise.sigma > noise.quantum:
        if noise.quantum < 0.1 * noise.sigma:
            return top
        levels = [np.abs(value - top + step * noise.quantum) < 0.5 * noise.quantum for step in range(1, NEXT_LEVELS)]
        below = max(int(level.sum()) for level in levels)
        return top if is_tie.sum() > max(PILE * below, 2 * MIN_TIES) else None
    return top if may_be_smooth and _is_reached_fast(t_s, value, is_tie, noise.quantum) else None


def _is_reached_fast(t_s: FloatArray, value: FloatArray, is_tie: BoolArray, quantum: float) -> bool:
    """Return whether the longest row at the top is reached without slowing down, and is longer than a turn there.

    From 4 d to d below its end, a decay takes ln 4 τ, and on to the last half step at least ln 8 τ for d of 4 steps or
    more; a parabola takes as long for both to its vertex, and less to a ceiling below it. A turn at constant
    acceleration stays on the last step at most 4 times as long as on the step before.
    """
    starts, lengths = _find_rows(is_tie.astype(np.float64))
    is_top = is_tie[starts]
    at = int(starts[is_top][np.argmax(lengths[is_top])])
    length = int(lengths[is_top].max())
    range_, dt_s = float(np.ptp(value)), float(np.median(np.diff(t_s)))
    band = max(APPROACH * range_, TURN_STEPS * quantum)
    if length < MIN_TIES or 4.0 * band > RISE * range_:
        return False
    crossings_s = [_find_crossing(t_s, value, at, depth) for depth in (RISE * range_, 4.0 * band, band)]
    steps_s = _find_crossing(t_s, value, at, TURN_STEPS * quantum if quantum else band)
    if np.isnan(crossings_s).any() or t_s[at] - crossings_s[0] < (MIN_RISE - 1) * dt_s:
        return False
    usual_s, slow_s = crossings_s[2] - crossings_s[1], t_s[at] - crossings_s[2]  # late by a sample at most
    return bool(slow_s <= usual_s + dt_s and length * dt_s >= TURN * (t_s[at] - steps_s))


def _find_crossing(t_s: FloatArray, value: FloatArray, at: int, depth: float) -> float:
    """Return the last time before a sample at which the signal was this far below it, s, or NaN."""
    below = np.flatnonzero(value[:at] < value[at] - depth)
    if not len(below):
        return float("nan")
    row = int(below[-1])
    return float(np.interp(value[at] - depth, value[row : row + 2], t_s[row : row + 2]))


def select_near_ceiling(value: FloatArray, ceiling: float, reach: float) -> BoolArray:
    """Return the samples at a ceiling and, if any is there, near it. Gaps count too, so that noise does not select."""
    noise = measure_noise(value)
    margin = max(CEILING_SIGMAS * noise.sigma, 2.0 * noise.quantum) + reach
    is_near = value >= ceiling - margin
    if not len(value) or value.max() < ceiling - reach:
        return np.zeros(len(value), dtype=bool)
    rows = np.flatnonzero(is_near)
    for first, last in itertools.pairwise(rows):
        if last - first <= 4:
            is_near[first:last] = True
    return np.asarray(np.convolve(is_near, np.ones(5), mode="same") > 0.5)


def find_hold(t_s: FloatArray, value: FloatArray, few: int = HOLD_BLOCKS) -> Slow:
    """Return the interval of a slower channel whose samples are repeated, s, its times and values, or None.

    few: smallest number of blocks of samples, `FEW_BLOCKS` suffice where they are long
    """
    if len(value) < 2 * few:
        return None
    starts, lengths = _find_rows(value)
    fewest = min(few, FEW_BLOCKS) if float(np.median(lengths)) >= LONG_BLOCK else few
    if len(starts) < fewest + 2 or 1.0 - len(starts) / len(value) < HOLD_SHARE:
        return None
    dt_s = float(np.median(np.diff(t_s)))
    intervals_s = np.diff(t_s[starts[1:]])
    usual_s = float(np.median(intervals_s))
    period_s = float(intervals_s[np.abs(intervals_s - usual_s) < 1.5 * dt_s].mean())
    count = np.round(intervals_s / period_s)
    if period_s < 1.8 * dt_s or float((count == 1.0).mean()) < 0.5:
        return None
    tolerance_s = 1.2 * dt_s if period_s > 4.0 * dt_s else 0.3 * dt_s
    is_regular = np.abs(intervals_s - np.maximum(count, 1.0) * period_s) <= tolerance_s
    steps = np.abs(np.diff(value[starts]))
    is_large = steps > 1.5 * find_quantum(value, 2)
    if float(is_regular.mean()) < HOLD_REGULAR or float(is_large.mean()) < HOLD_STEPS:
        return None
    return period_s, t_s[starts[1:]], value[starts[1:]]  # the first block began before the recording


def find_interpolation(t_s: FloatArray, value: FloatArray, few: int = MIN_SEGMENTS) -> Slow:
    """Return the interval of a slower channel whose samples are joined by lines, s, its times and values, or None.

    few: smallest number of lines
    """
    if len(value) < 2 * few * MIN_SEGMENT:
        return None
    dt_s, slope = np.diff(t_s), np.diff(value) / np.diff(t_s)
    precision = float(np.abs(value).max()) * (2.0**-22 if np.all(value == value.astype(np.float32)) else 2.0**-48)
    tolerance = 4.0 * max(precision, find_quantum(value)) / float(np.median(dt_s))
    is_corner = np.abs(np.diff(slope)) > tolerance
    is_sloped = np.abs(slope[1:]) > 3.0 * tolerance
    if not is_sloped.any() or float((~is_corner[is_sloped]).mean()) < COLLINEAR_SHARE:
        return None
    bounds = np.concatenate([[-1], np.flatnonzero(is_corner), [len(is_corner)]])
    parts = [(int(a) + 1, int(b) + 1) for a, b in itertools.pairwise(bounds) if b - a >= MIN_SEGMENT]
    lines = [(first, last, (value[last] - value[first]) / (t_s[last] - t_s[first])) for first, last in parts]
    knots_s = []
    for (a, b, one), (c, _, other) in itertools.pairwise(lines):
        if abs(one - other) > 20.0 * tolerance and c - b <= 1:
            knots_s.append((value[c] - other * t_s[c] - value[a] + one * t_s[a]) / (one - other))
    if len(knots_s) < few:
        return None
    intervals_s = np.diff(knots_s)
    usual_s = float(np.median(intervals_s))
    count = np.round(intervals_s / usual_s)
    if float((np.abs(intervals_s - count * usual_s) < 0.2 * usual_s).mean()) < HOLD_REGULAR or (count < 1.0).any():
        return None
    period_s = float((knots_s[-1] - knots_s[0]) / count.sum())
    number = np.concatenate([[0.0], np.cumsum(count)])
    period_s, zero_s = np.polyfit(number, knots_s, 1)
    every = np.arange(np.ceil((t_s[0] - zero_s) / period_s), np.floor((t_s[-1] - zero_s) / period_s) + 1.0)
    every_s = zero_s + period_s * every
    firsts = np.array([first for first, _, _ in lines])
    row = np.clip(np.searchsorted(t_s[firsts], every_s) - 1, 0, len(lines) - 1)
    slopes = np.array([slope for _, _, slope in lines])
    is_inside = every_s <= t_s[np.array([last for _, last, _ in lines])][row] + 2.0 * float(np.median(dt_s))
    values = value[firsts[row]] + slopes[row] * (every_s - t_s[firsts[row]])
    return float(period_s), every_s[is_inside], values[is_inside]


def find_outlier_candidates(t_s: FloatArray, value: FloatArray, quantum: float = 0.0) -> list[tuple[int, int, float]]:
    """Return first sample, number of samples and σ of deviations from both sides, near an end from the other one.

    quantum: step of the converter, where the values do not show it
    """
    count = len(value)
    if count < 4 * SIDE + MAX_WIDTH:
        return []
    noise = measure_noise(value)
    floor = max(0.5 * noise.quantum, quantum, 1e-9 * float(np.abs(value).max()), 1e-300)
    left = [_predict(t_s, value, k) for k in range(1, MAX_WIDTH + 1)]
    right = [_predict(-t_s[::-1], value[::-1], k)[::-1] for k in range(1, MAX_WIDTH + 1)]
    scores = []
    for sides in (left, right):
        deviations = [value - predicted for predicted in sides]
        known = [np.abs(item[np.isfinite(item)]) for item in deviations]
        scales = [max(1.4826 * float(np.median(item)), floor) if len(item) else np.inf for item in known]
        scores.append([item / scale for item, scale in zip(deviations, scales, strict=True)])
    found: list[tuple[int, int, float]] = []
    taken = np.zeros(count, dtype=bool)
    for width in range(MAX_WIDTH, 0, -1):  # a narrower one inside a wider one is a part of it
        score = np.full(count - width + 1, np.inf)
        firsts = np.arange(len(score))
        is_begin, is_end = firsts < SIDE, firsts + width > count - SIDE
        for at in range(width):
            a = scores[0][at][at : count - width + 1 + at]
            b = scores[1][width - 1 - at][at : count - width + 1 + at]
            both = np.where(a * b > 0.0, np.minimum(np.abs(a), np.abs(b)), 0.0)
            both = np.select([is_begin, is_end], [np.abs(b), np.abs(a)], both)
            score = np.minimum(score, np.nan_to_num(both))
        for first in np.flatnonzero(score > (OUTLIER_SIGMAS if noise.is_rough else SMOOTH_SIGMAS)).tolist():
            own = slice(first, first + width)
            if not taken[own].any() and _is_isolated(t_s, value, first, width, max(noise.sigma, floor)):
                found.append((first, width, float(score[first])))
                taken[own] = True
    return sorted(found)


def _predict(t_s: FloatArray, value: FloatArray, ahead: int) -> FloatArray:
    """Return the value of each sample that a line through `SIDE` samples predicts which end `ahead` samples before it.

    NaN where there are none or where a gap is among them.
    """
    out = np.full(len(value), np.nan)
    times, values = sliding_window_view(t_s, SIDE), sliding_window_view(value, SIDE)
    times, values, target_s = times[: len(times) - ahead], values[: len(values) - ahead], t_s[SIDE - 1 + ahead :]
    centre_s, mean = times.mean(axis=1), values.mean(axis=1)
    offset_s = times - centre_s[:, None]
    slope = (offset_s * values).sum(axis=1) / (offset_s**2).sum(axis=1)
    near = target_s - times[:, 0] < 2.0 * (SIDE + ahead) * float(np.median(np.diff(t_s)))
    out[SIDE - 1 + ahead :] = np.where(near, mean + slope * (target_s - centre_s), np.nan)
    return out


def _is_isolated(t_s: FloatArray, value: FloatArray, first: int, width: int, sigma: float) -> bool:
    """Return whether a cubic through the neighbours fits these far better than the samples between them."""
    deviation, local = measure_deviation(t_s, value, first, width)
    return deviation > ROUGHNESS * max(sigma, local)


def measure_deviation(t_s: FloatArray, value: FloatArray, first: int, width: int) -> tuple[float, float]:
    """Return the smallest deviation of samples from a cubic through their neighbours, and that of these, rms."""
    begin = min(max(first - SIDE, 0), max(len(value) - width - 2 * SIDE, 0))  # near an end more of the other side
    rows = np.setdiff1d(np.arange(begin, min(begin + width + 2 * SIDE, len(value))), np.arange(first, first + width))
    if len(rows) < 2 * SIDE:
        return 0.0, 0.0
    span_s = float(t_s[rows[-1]] - t_s[rows[0]])
    centre_s = float(t_s[first : first + width].mean())
    design = np.vander((t_s[rows] - centre_s) / span_s, 4)
    solved = np.linalg.lstsq(design, value[rows], rcond=None)[0]
    left = value[rows] - design @ solved
    own = np.vander((t_s[first : first + width] - centre_s) / span_s, 4)
    deviation = np.abs(value[first : first + width] - own @ solved)
    return float(deviation.min()), float(np.sqrt((left**2).sum() / (len(rows) - 4)))
