"""Contrasts between repeats: differences between runs of one group hold noise and jitters but no model.

What jitters of power and timing do to them follows from a fit plus its mean residual over the repeats, which is the
measured trace: a fit without the effect that bends this trace at its edges would let repeats seem to differ.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, Dataset

MIRROR_SETTLED_S = 4e-3
MIN_COMMON = 16
"""Smallest number of samples of a contrast."""
MIN_GROWTH = 1.7
"""Growth of the variance of second differences with twice the step, from which neighbours hold no noise of their own:
it is 1 for white noise, and 2 for a mean of many samples."""
MAX_WINDOW = 64
"""Largest number of samples that are averaged."""


@dataclass(frozen=True, eq=False)
class JitterSensitivity:
    """Derivatives of the prediction [m] with respect to the logarithm of the power and to a delay, per second."""

    power: FloatArray
    timing: FloatArray


@dataclass(frozen=True, eq=False)
class Contrast:
    """Contrast between repeats in one signal kind.

    value: [n]; jitter: sensitivities [n, 3] to power, timing and baseline; pair: number of the pair of runs; block:
    number of the last repeat's block in the dataset
    """

    pair: int
    kind: int
    block: int
    t_s: FloatArray
    value: FloatArray
    jitter: FloatArray


def compute_contrasts(data: Dataset, residual: FloatArray, sensitivity: JitterSensitivity) -> list[Contrast]:
    """Compute Helmert contrasts between the runs of each group on their common samples."""
    contrasts: list[Contrast] = []
    blocks: dict[tuple[int, int, int], int] = {
        (block.run, block.kind, block.pixel): number for number, block in enumerate(data.blocks)
    }
    pair = 0
    for runs in data.groups.values():
        for later in range(1, len(runs)):
            used = False
            for number, kind, pixel in list(blocks):
                if number != runs[later]:
                    continue
                block_numbers = [blocks.get((run, kind, pixel)) for run in runs[: later + 1]]
                if any(number is None for number in block_numbers):
                    continue
                members = [data.blocks[number] for number in block_numbers if number is not None]
                common = _find_common_rows(members[0].t_s, [member.t_s for member in members[1:]])
                if common is None:
                    continue
                commands = data.runs[number].commands
                if kind in MIRROR_KINDS and commands is not None:
                    common = _select_settled(members[0].t_s, common, commands[:, 0])
                # Helmert's contrasts of one group are independent of each other, which plain differences are not.
                scale = sqrt(later / (later + 1.0))
                weights = [*([scale / later] * later), -scale]
                rows = [member.part.start + picked for member, picked in zip(members, common, strict=True)]
                times_s = [member.t_s[picked] for member, picked in zip(members, common, strict=True)]
                last, block, t_s = rows[-1], blocks[number, kind, pixel], times_s[-1]
                # With the mean residual, jitters act along the measured trace, also where the model misses it.
                mean = np.mean([residual[r] for r in rows], axis=0)
                missed = np.gradient(mean, t_s)
                # Where runs are sampled at other phases, so much of the difference is what the model misses.
                moved = [residual[r] - missed * (own_s - t_s) for r, own_s in zip(rows, times_s, strict=True)]
                value = np.asarray(weights) @ np.array(moved)
                power, timing = sensitivity.power[last] + mean, sensitivity.timing[last] - missed
                jitter = np.stack([power, timing, np.ones(len(last))], axis=1)
                contrasts.append(Contrast(pair, kind, block, t_s, value, jitter))
                used = True
            pair += used
    return contrasts


def _select_settled(t_s: FloatArray, common: list[IntArray], steps_s: FloatArray) -> list[IntArray]:
    """Select rows at which the mirrors have settled: the effect of jitter on a moving mirror is no instrument noise."""
    times = t_s[common[0]]
    row = np.searchsorted(steps_s, times, side="right") - 1
    is_settled = (row < 0) | (times - steps_s[np.maximum(row, 0)] > MIRROR_SETTLED_S)
    # A recording of moving mirrors only keeps them: a noise too large is better than none.
    return [rows[is_settled] for rows in common] if is_settled.sum() >= 16 else common


def _find_common_rows(first: FloatArray, others: list[FloatArray]) -> list[IntArray] | None:
    """Return the rows of each time axis that belong together, or None for fewer than 16.

    These are times that all axes share to 0.1 µs. Free-running instruments share none: then each sample belongs to the
    nearest one of the first axis, within half an interval, in which residuals change along their mean.
    """
    # Equality of floating-point times would fail in the last digit.
    keys = [np.round(times * 1e7).astype(np.int64) for times in (first, *others)]
    shared = keys[0]
    for key in keys[1:]:
        shared = np.intersect1d(shared, key, assume_unique=True)
    if len(shared) >= MIN_COMMON:
        return [np.searchsorted(key, shared).astype(np.int64) for key in keys]
    if len(first) < MIN_COMMON:
        return None
    nearest = [_match_nearest(first, times) for times in others]
    kept = np.flatnonzero(np.all([rows >= 0 for rows in nearest], axis=0))
    return [kept, *(rows[kept] for rows in nearest)] if len(kept) >= MIN_COMMON else None


def _match_nearest(first: FloatArray, times: FloatArray) -> IntArray:
    """Return the row of the nearest time for each of the first axis, each at most once, or −1."""
    middle = 0.5 * (first[1:] + first[:-1])
    owner = np.searchsorted(middle, times)
    distance = np.abs(times - first[owner])
    best = np.lexsort((distance, owner))
    owners, at = np.unique(owner[best], return_index=True)
    rows = np.full(len(first), -1, dtype=np.int64)
    is_near = distance[best][at] <= 0.51 * float(np.median(np.diff(first)))
    rows[owners[is_near]] = best[at][is_near]
    return rows


@dataclass(frozen=True)
class NoiseWindow:
    """Number of samples over which noise is smooth, of a signal that is sampled at this interval [s].

    reach: samples in a moving mean of such noise, not rounded to a power of two
    """

    interval_s: float
    count: int
    reach: float = 1.0


Windows = tuple[NoiseWindow, ...]


def find_windows(contrasts: list[Contrast]) -> Windows:
    """Return the windows of one signal kind for each of its sampling intervals.

    A program that averages, or filters both ways, leaves noise that no process of few states describes, and that is a
    matter of samples where they are averaged. Means over the length of that noise are nearly independent again.
    """
    classes: dict[int, list[tuple[float, FloatArray]]] = {}
    for item in contrasts:
        interval_s = float(np.median(np.diff(item.t_s)))
        # Jitters are smooth, and would pass for noise that was filtered.
        values = item.value - item.jitter @ np.linalg.lstsq(item.jitter, item.value, rcond=None)[0]
        classes.setdefault(round(4.0 * np.log2(interval_s)), []).append((interval_s, values))
    return tuple(
        NoiseWindow(float(np.median([interval_s for interval_s, _ in members])), *_count_smooth(members))
        for members in classes.values()
    )


def _count_smooth(members: list[tuple[float, FloatArray]]) -> tuple[int, float]:
    """Return `count` and `reach` of the window at which the noise of these contrasts stops to be smooth.

    Second differences of means of n samples with the step k have a variance of 4 k / n up to k = n / 2, of 8 k / n − 2
    up to k = n, and of 6 from there on.
    """
    # Windows are powers of two.
    count, longest = 1, max(len(values) for _, values in members)
    # Longer windows would leave too few means to estimate the noise from.
    while count < min(MAX_WINDOW, longest // 8):
        steps = (count, 2 * count)
        spreads = [
            [float(np.median(np.abs(v[2 * step :] - 2.0 * v[step:-step] + v[: -2 * step]))) ** 2 for step in steps]
            for _, v in members
            if len(v) > 8 * count
        ]
        before, after = np.sum(spreads, axis=0)
        if not after > MIN_GROWTH * before > 0.0:
            return count, 8.0 * count / (6.0 * before / after + 2.0) if count > 1 else 1.0
        count *= 2
    return count, float(count)


def average_windows(t_s: FloatArray, columns: FloatArray, windows: Windows) -> tuple[FloatArray, FloatArray]:
    """Return times and means of columns [n, k] in their windows.

    Times count windows, in units of the shortest one, because noise that was averaged by samples follows their number.
    """
    if all(item.count == 1 for item in windows):  # first: it is asked for with every fit of every signal
        return t_s, columns
    window = find_window(t_s, windows)
    if window is None:
        return t_s, columns
    label = ((t_s - t_s[0]) / (window.count * window.interval_s) + 1e-6).astype(np.int64)
    starts = np.flatnonzero(np.diff(label, prepend=-1))
    counts = np.diff(np.append(starts, len(t_s)))
    unit_s = min(item.count * item.interval_s for item in windows)
    return label[starts] * unit_s, np.add.reduceat(columns, starts, axis=0) / counts[:, None]


def find_window(t_s: FloatArray, windows: Windows) -> NoiseWindow | None:
    """Return the window for samples at these times."""
    if not windows or len(t_s) < 2:
        return None
    interval_s = float(np.median(np.diff(t_s)))
    return min(windows, key=lambda item: abs(np.log(item.interval_s / interval_s)))


def build_residual_contrasts(
    data: Dataset, residual: FloatArray, sensitivity: JitterSensitivity, kind: int
) -> list[Contrast]:
    """Return the residuals of one signal kind in place of contrasts, for recordings without repeats."""
    contrasts = []
    for number, block in enumerate(data.blocks):
        if block.kind == kind:
            part = block.part
            ones = np.ones(part.stop - part.start)
            jitter = np.stack([sensitivity.power[part], sensitivity.timing[part], ones], axis=1)
            contrasts.append(Contrast(block.run, kind, number, block.t_s, residual[part], jitter))
    return contrasts
