"""Hops of the zero of an instrument.

Theory of operation

Hops. Steps of the zero within a few samples, at times that differ between repeats, and in no other signal of the run:
what happens in the pixel or in the laser shows in all of them. Differences of means before and after are compared with
their own median in the same run, so that slow noise of any spectrum passes.
"""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import InstrumentDisturbance
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS, SIGNALS, Block, BoolArray, Dataset
from optodrive.lab.diagnosis.noise_model import NoiseModel, find_resolution, whiten
from optodrive.lab.diagnosis.replicate_contrasts import Contrast, JitterSensitivity, compute_contrasts, find_window

HOP_WINDOWS, MIN_HOP_SAMPLES = (6, 24), 60
SINGLE_HOP, PAIR_HOP, MORE_HOPS = 6.5, 5.5, 5.0
"""Smallest hop in robust σ of differences of means: of one run alone, of two runs, and of others beside them."""
HOP_ABRUPTNESS, QUICK = 0.6, 3
"""Share of a hop within that many samples."""
JITTER, JITTER_LEFT = (0.02, 1e-4), (1e-3, 1e-5)
"""Jitter of power, relative, and of time, s: a priori, and left where it is subtracted, as steps at edges of pulses."""
OTHER_SIGMAS, OTHER_USUAL = 4.5, 1.5
"""Largest change of another signal at a hop, in robust σ, and relative to what nine in ten of its samples have."""
HOP_SETTLED_S = 0.02
"""Time after a pulse from which a signal that was measured alone can hop."""
MAX_HOPS = 60


def find_hops(
    data: Dataset, residual: FloatArray, sensitivity: JitterSensitivity, noise: NoiseModel
) -> tuple[list[InstrumentDisturbance], FloatArray]:
    """Return the hops of each kind of signal and their values [m]."""
    added = np.zeros(len(residual))
    hops: dict[int, list[tuple[Block, int, float, float]]] = {}
    for _ in range(MAX_HOPS):
        min_scores = {kind: MORE_HOPS if _are_certain(hops.get(kind, [])) else PAIR_HOP for kind in PIXEL_KINDS}
        # One at a time: each is in all contrasts of its group, and would be found in its repeats again.
        hop = _find_largest_hop(data, residual - added, sensitivity, noise, min_scores)
        if hop is None:
            break
        block, first, size, _ = hop
        added[block.part.start + first : block.part.stop] += size
        hops.setdefault(block.kind, []).append(hop)
    found = []
    for kind, some in sorted(hops.items()):
        if _are_certain(some):
            runs = len({block.run for block, _, _, _ in some})
            size = float(np.median([abs(size) for _, _, size, _ in some]))
            found.append(InstrumentDisturbance(SIGNALS[kind], "hops", size, None, runs))
            continue
        for block, first, size, _ in some:
            # A single, not certain hop stays in the data: noise has the largest step somewhere.
            added[block.part.start + first : block.part.stop] -= size
    return found, added


def _are_certain(hops: list[tuple[Block, int, float, float]]) -> bool:
    """Return whether two runs hop, or one so much that noise alone does not reach it."""
    return len({block.run for block, _, _, _ in hops}) > 1 or any(score >= SINGLE_HOP for _, _, _, score in hops)


def _find_largest_hop(
    data: Dataset,
    residual: FloatArray,
    sensitivity: JitterSensitivity,
    noise: NoiseModel,
    min_scores: dict[int, float],
) -> tuple[Block, int, float, float] | None:
    """Return the block, the first sample, the size and the score of the most significant hop, or None.

    min_scores: score of a hop, by kind of signal
    """
    contrasts = [
        item
        for item in compute_contrasts(data, residual, sensitivity)
        if item.kind in PIXEL_KINDS and len(item.t_s) >= MIN_HOP_SAMPLES
    ]
    best: tuple[float, Contrast, float] | None = None
    scores = _score_hops(contrasts, noise, {kind: find_resolution(data, kind) for kind in data.kinds})
    for item, own in zip(contrasts, scores, strict=True):
        for at in np.flatnonzero(own.is_abrupt & (own.score > min_scores[item.kind])):
            found = float(own.score[at]), item, float(own.t_s[at])
            if (best is None or found[0] > best[0]) and _is_alone(data, item, found[2], contrasts, scores):
                best = found
    if best is None:
        return None
    score, item, time_s = best
    group = data.runs[data.blocks[item.block].run].group
    members = [
        block
        for block in data.blocks
        if block.kind == item.kind
        and block.pixel == data.blocks[item.block].pixel
        and data.runs[block.run].group == group
    ]
    steps = [(*_measure_step(block, residual[block.part], time_s), block) for block in members]
    # A contrast does not tell which of its runs hopped; the run itself does.
    first, size, block = max(steps, key=lambda step: abs(step[1]))
    return (block, first, size, score) if abs(size) > find_resolution(data, item.kind) else None


@dataclass(frozen=True, eq=False)
class _HopScores:
    """Times [k], differences of means there in robust σ, and whether these come within three samples."""

    t_s: FloatArray
    score: FloatArray
    is_abrupt: BoolArray


def _score_hops(contrasts: list[Contrast], noise: NoiseModel, resolutions: dict[int, float]) -> list[_HopScores]:
    """Return the scores of each contrast.

    Their σ is the median of contrasts that are sampled alike.

    resolutions: by kind of signal, below which σ does not fall
    """
    every = [_subtract_jitter(item, noise) for item in contrasts]
    kinds = [(item.kind, round(np.log2(float(np.median(np.diff(item.t_s)))))) for item in contrasts]
    scores = [_HopScores(item.t_s, np.zeros(len(item.t_s)), np.zeros(len(item.t_s), dtype=bool)) for item in contrasts]
    for width in HOP_WINDOWS:
        changes = [_compute_changes(values, width) for values in every]
        for kind in set(kinds):
            members = [row for row, other in enumerate(kinds) if other == kind]
            spreads = [float(np.median(np.abs(changes[row]))) for row in members if len(changes[row])]
            # The median over contrasts: one with many hops would raise its own threshold.
            spread = max(1.4826 * float(np.median(spreads or [0.0])), resolutions[kind[0]])
            for row in members:
                rows = np.arange(width, width + len(changes[row]))
                jitter = [_compute_changes(column, width) for column in contrasts[row].jitter.T[:2]]
                # At a pulse's edge, what is left of a jitter is a step and no hop.
                left = [share * change for share, change in zip(JITTER_LEFT, jitter, strict=True)]
                ratio = np.abs(changes[row]) / np.sqrt(spread**2 + left[0] ** 2 + left[1] ** 2)
                quick = _compute_changes(every[row], QUICK)[rows - QUICK] * np.sign(changes[row])
                is_larger = ratio > scores[row].score[rows]
                scores[row].score[rows[is_larger]] = ratio[is_larger]
                window = find_window(contrasts[row].t_s, noise.coloured[kind[0]].windows)
                # Where a program averaged, no zero hops so fast; what it made of missing samples looks as if.
                can_hop = window is None or window.count <= QUICK
                is_abrupt = can_hop & (quick > HOP_ABRUPTNESS * np.abs(changes[row]))
                scores[row].is_abrupt[rows[is_larger]] = is_abrupt[is_larger]
    return scores


def _subtract_jitter(item: Contrast, noise: NoiseModel) -> FloatArray:
    """Return the values of a contrast without their jitters, as estimated under its coloured noise."""
    size = np.array(JITTER)
    columns = np.column_stack([item.value, item.jitter[:, :2] * size, np.ones(len(item.value))])
    whitened, _ = whiten(item.t_s, columns, noise.coloured[item.kind])
    gram = whitened.T @ whitened
    solved = np.linalg.solve(gram[1:, 1:] + np.diag([1.0, 1.0, 1e-9 * gram[3, 3]]), gram[1:, 0])
    return np.asarray(item.value - columns[:, 1:] @ solved)


def _compute_changes(values: FloatArray, width: int) -> FloatArray:
    """Return the mean of as many samples from each on, less that of as many before it, from sample `width` on."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    rows = np.arange(width, len(values) - width + 1)
    return np.asarray((total[rows + width] - 2.0 * total[rows] + total[rows - width]) / width)


def _is_alone(
    data: Dataset, item: Contrast, time_s: float, contrasts: list[Contrast], scores: list[_HopScores]
) -> bool:
    """Return whether no other signal of the same runs changes at that time."""
    others = [
        own for other, own in zip(contrasts, scores, strict=True) if other.pair == item.pair and other.kind != item.kind
    ]
    reach_s = HOP_WINDOWS[-1] * float(np.median(np.diff(item.t_s)))
    for own in others:
        near = own.score[np.abs(own.t_s - time_s) <= reach_s]
        usual = OTHER_USUAL * float(np.quantile(own.score, 0.9))  # large where pulses differ by more than jitter
        if float(near.max(initial=0.0)) > max(OTHER_SIGMAS, usual):
            return False
    if others:
        return True
    pulses = data.runs[data.blocks[item.block].run].pulses
    return not bool(((pulses[:, 0] - reach_s < time_s) & (time_s < pulses[:, 0] + pulses[:, 1] + HOP_SETTLED_S)).any())


def _measure_step(block: Block, residual: FloatArray, time_s: float) -> tuple[int, float]:
    """Return the first sample after a step near a time, and its size."""
    middle = int(np.searchsorted(block.t_s, time_s))
    narrow, wide = HOP_WINDOWS
    changes = np.abs(_compute_changes(residual, narrow))
    first, last = max(middle - 2 * narrow, 0), min(middle + 1, len(changes))
    if first >= last:
        return middle, 0.0
    at = narrow + first + int(np.argmax(changes[first:last]))
    after, before = residual[at : at + wide], residual[max(at - wide, 0) : at]
    return at, float(after.mean() - before.mean())
