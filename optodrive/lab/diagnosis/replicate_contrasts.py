"""Contrasts between repeats: differences between runs of one group hold noise and jitters but no model."""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, Dataset

MIRROR_SETTLED_S = 4e-3
MIN_COMMON = 16
"""Smallest number of samples of a contrast."""


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


def compute_contrasts(data: Dataset, residual: FloatArray, power: FloatArray, timing: FloatArray) -> list[Contrast]:
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
                scale = sqrt(later / (later + 1.0))
                weights = [*([scale / later] * later), -scale]
                rows = [member.part.start + picked for member, picked in zip(members, common, strict=True)]
                value = sum(w * residual[r] for w, r in zip(weights, rows, strict=True))
                last, block = rows[-1], blocks[number, kind, pixel]
                jitter = np.stack([power[last], timing[last], np.ones(len(last))], axis=1)
                contrasts.append(Contrast(pair, kind, block, members[-1].t_s[common[-1]], value, jitter))
                used = True
            pair += used
    return contrasts


def _select_settled(t_s: FloatArray, common: list[IntArray], steps_s: FloatArray) -> list[IntArray]:
    """Select rows at which the mirrors have settled: the effect of jitter on a moving mirror is no instrument noise."""
    times = t_s[common[0]]
    row = np.searchsorted(steps_s, times, side="right") - 1
    is_settled = (row < 0) | (times - steps_s[np.maximum(row, 0)] > MIRROR_SETTLED_S)
    return [rows[is_settled] for rows in common] if is_settled.sum() >= 16 else common


def _find_common_rows(first: FloatArray, others: list[FloatArray]) -> list[IntArray] | None:
    """Return the rows of each time axis that belong together, or None for fewer than 16.

    These are times that all axes share to 0.1 µs. Free-running instruments share none: then each sample belongs to the
    nearest one of the first axis, within half an interval. What the residuals change by in this time counts as noise.
    """
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


def build_residual_contrasts(
    data: Dataset, residual: FloatArray, power: FloatArray, timing: FloatArray, kind: int
) -> list[Contrast]:
    """Return the residuals of one signal kind in place of contrasts, for recordings without repeats."""
    contrasts = []
    for number, block in enumerate(data.blocks):
        if block.kind == kind:
            part = block.part
            jitter = np.stack([power[part], timing[part], np.ones(part.stop - part.start)], axis=1)
            contrasts.append(Contrast(block.run, kind, number, block.t_s, residual[part], jitter))
    return contrasts
