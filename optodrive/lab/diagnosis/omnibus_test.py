"""Whether whitened residuals agree with zero in bins of group × signal × time after an edge.

The same bins of the differences between repeats hold noise alone: their size is the scale.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2 as chi_squared
from scipy.stats import f as fisher

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.lab.diagnosis.dataset import Dataset
from optodrive.lab.diagnosis.fitting import Jitter, Problem
from optodrive.lab.diagnosis.noise_model import whiten
from optodrive.lab.diagnosis.normal_equations import projected
from optodrive.lab.diagnosis.prediction import BASE

AFTER_S = np.geomspace(5e-4, 1.0, 9)
"""Edges of the bins: time after an edge of the light."""
SPAN = 4
"""Bins over a whole run, for what is slower."""
RIDGE = 1e-4


@dataclass(frozen=True)
class Binned:
    """χ² in bins and its degrees; the same of the differences between repeats, which hold noise alone."""

    chi2: float
    degrees: int
    noise_chi2: float
    noise_degrees: int

    def p_value(self) -> float:
        """Of an F: the noise that repeats show is the scale, as far as it is more than the noise model has."""
        if not self.degrees:
            return 1.0
        if not self.noise_degrees:
            return float(chi_squared.sf(self.chi2, self.degrees))
        scale = max(1.0, self.noise_chi2 / self.noise_degrees)
        return float(fisher.sf(self.chi2 / self.degrees / scale, self.degrees, self.noise_degrees))


def binned(problem: Problem, columns: FloatArray, shared: Jitter) -> Binned:
    """Of the last of columns [m, k] in the omnibus' bins, beside the others."""
    data, noise, kinds = problem.data, problem.noise, problem.data.kinds()
    labels, width = bins(data), columns.shape[1]
    count = int(labels.max()) + 1
    total = np.zeros((width + count, width + count))
    if width > len(BASE):
        total[range(len(BASE)), range(len(BASE))] = 1.0 / np.square(problem.prior.sigma)
    noise_chi2, noise_degrees = 0.0, 0
    groups: dict[str, tuple[FloatArray, FloatArray]] = {}
    by_run: dict[int, list[int]] = {}
    for place, block in enumerate(data.blocks):
        by_run.setdefault(block.run, []).append(place)
    for run, places in by_run.items():
        own = _binned_rows(np.concatenate([labels[data.blocks[place].part] for place in places]))
        size = 2 + len(kinds)
        gram = np.zeros((width + len(own) + size, width + len(own) + size))
        for place in places:
            block = data.blocks[place]
            part, kind = block.part, kinds.index(block.kind)
            local = _binned_rows(labels[part])
            indicators = (labels[part][:, None] == local).astype(np.float64)
            jitters = np.column_stack(
                [
                    noise.power * shared.power[part],
                    noise.timing_s * shared.timing[part],
                    np.full(part.stop - part.start, noise.baseline[block.kind]),
                ]
            )
            whitened, _ = whiten(block.t_s, np.hstack([columns[part], indicators, jitters]), noise.coloured[block.kind])
            where = np.concatenate(
                [
                    np.arange(width),
                    width + np.searchsorted(own, local),
                    width + len(own) + np.array([0, 1, 2 + kind]),
                ]
            )
            gram[np.ix_(where, where)] += whitened.T @ whitened
        kept = width + len(own)
        inner = gram[kept:, kept:] + np.eye(size)
        reduced = gram[:kept, :kept] - gram[:kept, kept:] @ np.linalg.solve(inner, gram[kept:, :kept])
        where = np.concatenate([np.arange(width), width + own])
        total[np.ix_(where, where)] += reduced
        here, one = reduced[width:, width:], reduced[width:, width - 1]
        chi2, degrees = _quadratic(here, one)
        noise_chi2, noise_degrees = noise_chi2 + chi2, noise_degrees + degrees
        gram_sum, one_sum = groups.setdefault(data.runs[run].group, (np.zeros((count, count)), np.zeros(count)))
        gram_sum[np.ix_(own, own)] += here
        one_sum[own] += one
    for gram_sum, one_sum in groups.values():
        chi2, degrees = _quadratic(gram_sum, one_sum)
        noise_chi2, noise_degrees = noise_chi2 - chi2, noise_degrees - degrees
    out, last = list(range(width - 1)), width - 1
    left = projected(total, out, [*range(width, width + count), last])
    chi2, degrees = _quadratic(left[:-1, :-1], left[:-1, -1])
    return Binned(chi2, degrees, noise_chi2, noise_degrees)


def _quadratic(among: FloatArray, right: FloatArray) -> tuple[float, int]:
    """rightᵀ among⁻¹ right, and over how many bins that say anything."""
    spread = np.sqrt(np.diag(among))
    seen = spread > 1e-9 * spread.max(initial=0.0)
    kept = np.flatnonzero(seen)
    alike = among[np.ix_(kept, kept)] / spread[kept] / spread[kept][:, None] + RIDGE * np.eye(len(kept))
    parts = right[kept] / spread[kept]
    return float(parts @ cho_solve(cho_factor(alike), parts)), len(kept)


def by_group(problem: Problem, residual: FloatArray, shared: Jitter) -> FloatArray:
    """χ² of a residual in each group's bins, and its degrees: [groups, 2]."""
    data = problem.data
    out = []
    for runs in data.groups().values():
        own = data.only(runs)
        part = np.concatenate([np.arange(b.part.start, b.part.stop) for b in data.blocks if b.run in runs])
        here = Jitter(shared.power[part], shared.timing[part])
        found = binned(replace(problem, data=own), residual[part][:, None], here)
        out.append((found.chi2, found.degrees))
    return np.array(out, dtype=np.float64)


def _binned_rows(labels: IntArray) -> IntArray:
    return np.asarray(np.unique(labels[labels >= 0]))


def bins(data: Dataset) -> IntArray:
    """[m] the omnibus' bin of each sample, −1 for none: group × signal × pixel × (log time after an edge, time)."""
    names: dict[tuple[object, ...], int] = {}
    label = np.full(len(data.value), -1, dtype=np.int64)
    for block in data.blocks:
        run = data.runs[block.run]
        edges_s, rising = _edges(run.pulses, run.commands if block.kind >= 3 else None)
        row = np.searchsorted(edges_s, block.t_s, side="right") - 1
        after_s = block.t_s - edges_s[np.maximum(row, 0)]
        slot = np.searchsorted(AFTER_S, after_s)
        long = len(run.pulses) > 2
        span_s = max(float(block.t_s[-1] - block.t_s[0]), 1e-9)
        piece = ((block.t_s - block.t_s[0]) / span_s * SPAN).astype(int).clip(0, SPAN - 1) if long else 0 * slot
        order = np.where(row < 0, -1, np.where(rising[np.maximum(row, 0)], 0, 1) + 2 * (0 if long else 1) * (row // 2))
        keys = zip(order.tolist(), slot.tolist(), piece.tolist(), strict=True)
        for at, key in enumerate(keys, start=block.part.start):
            whole = (run.group, block.kind, block.pixel, *key)
            label[at] = names.setdefault(whole, len(names))
    return label


def _edges(pulses: FloatArray, commands: FloatArray | None) -> tuple[FloatArray, np.ndarray]:
    if commands is not None:
        return commands[:, 0], np.arange(len(commands)) % 2 == 0
    edges_s = np.concatenate([pulses[:, 0], pulses[:, 0] + pulses[:, 1]])
    order = np.argsort(edges_s, kind="stable")
    rising = np.concatenate([np.ones(len(pulses), dtype=bool), np.zeros(len(pulses), dtype=bool)])
    if not len(edges_s):
        return np.zeros(1), np.ones(1, dtype=bool)
    return edges_s[order], rising[order]
