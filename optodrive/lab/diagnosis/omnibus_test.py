"""Omnibus test of whitened residuals against zero in bins of group, signal and time after a gate edge.

The same bins of the differences between repeats hold noise only and set the scale. Hundreds of means hide an effect
that all groups share; so the groups' bins are joined, too, each weighed by the group's span: what heats twice as much
shows an effect about twice as large.
"""

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.lab.diagnosis.dataset import Dataset
from optodrive.lab.diagnosis.evidence import BinEvidence, compute_bin_evidence
from optodrive.lab.diagnosis.fitting import FitProblem, project_out, reduce_run
from optodrive.lab.diagnosis.prediction import BASE_PARAMETERS
from optodrive.lab.diagnosis.replicate_contrasts import JitterSensitivity

EDGE_BINS_S = np.geomspace(5e-4, 1.0, 9)
"""Bin edges of the time after a gate edge."""
JOINED_BINS_S = np.array([2e-3, 1e-2, 1e-1])
"""The same of the bins that join all groups, few enough for an effect of seven σ to be seen in them."""
RUN_BINS = 4
"""Number of bins over a whole run, for slow effects."""
RIDGE = 1e-4
_known_bins: "WeakKeyDictionary[Dataset, Bins]" = WeakKeyDictionary()


@dataclass(frozen=True)
class OmnibusStatistic:
    """χ² in bins with its degrees of freedom, and the same of differences between repeats, which hold noise only.

    evidence: for independent means of the bins, and of the joined bins
    """

    chi2: float
    degrees: int
    noise_chi2: float
    noise_degrees: int
    evidence: BinEvidence


@dataclass(frozen=True, eq=False)
class Bins:
    """Bins of a dataset.

    label: [m] of each sample, −1 for none; joined: [bins, k] weight of each bin in the bins that join all groups
    """

    label: IntArray
    joined: FloatArray


class _Noise:
    """χ² and degrees of freedom of bins within the groups: of all runs, less those of their sums."""

    def __init__(self) -> None:
        self.chi2, self.degrees = 0.0, 0

    def add(self, gram: FloatArray, right: FloatArray, sign: int) -> None:
        """Add the bins of a run, or subtract those of a group."""
        chi2, degrees = _compute_quadratic_form(gram, right)
        self.chi2, self.degrees = self.chi2 + sign * chi2, self.degrees + sign * degrees


def compute_omnibus(problem: FitProblem, columns: FloatArray, sensitivity: JitterSensitivity) -> OmnibusStatistic:
    """Compute the statistic of the last of the columns [m, k], with the others projected out."""
    data = problem.data
    bins, width = _find_bins(data), columns.shape[1]
    labels, count = bins.label, len(bins.joined)
    total = np.zeros((width + count, width + count))
    if width > len(BASE_PARAMETERS):
        total[range(len(BASE_PARAMETERS)), range(len(BASE_PARAMETERS))] = 1.0 / np.square(problem.prior.sigma)
    own_noise, joined_noise = _Noise(), _Noise()
    groups: dict[str, tuple[FloatArray, FloatArray]] = {}
    for run, blocks in enumerate(data.run_blocks):
        if not blocks:
            continue
        run_bins = _list_bins(np.concatenate([labels[block.part] for block in blocks]))
        parts = []
        for block in blocks:
            label = labels[block.part]
            block_bins = _list_bins(label)
            indicators = (label[:, None] == block_bins).astype(np.float64)
            places = np.concatenate([np.arange(width), width + np.searchsorted(run_bins, block_bins)])
            parts.append((block, np.hstack([columns[block.part], indicators]), places))
        size = width + len(run_bins)
        reduced = reduce_run(parts, size, data.kinds, problem.noise, sensitivity)
        indices = np.concatenate([np.arange(width), width + run_bins])
        total[np.ix_(indices, indices)] += reduced
        bin_gram, bin_right = reduced[width:, width:], reduced[width:, width - 1]
        joined = _select_joined(bins, run_bins)
        own_noise.add(bin_gram, bin_right, 1)
        joined_noise.add(joined.T @ bin_gram @ joined, joined.T @ bin_right, 1)
        gram_sum, one_sum = groups.setdefault(data.runs[run].group, (np.zeros((count, count)), np.zeros(count)))
        gram_sum[np.ix_(run_bins, run_bins)] += bin_gram
        one_sum[run_bins] += bin_right
    for gram_sum, one_sum in groups.values():
        used = np.flatnonzero(np.diag(gram_sum))
        joined = _select_joined(bins, used)
        own_noise.add(gram_sum, one_sum, -1)
        joined_noise.add(joined.T @ gram_sum[np.ix_(used, used)] @ joined, joined.T @ one_sum[used], -1)
    removed, last = list(range(width - 1)), width - 1
    projected = project_out(total, removed, [*range(width, width + count), last])
    correlation, scaled = _scale_informative(projected[:-1, :-1], projected[:-1, -1])
    chi2 = float(scaled @ cho_solve(cho_factor(correlation), scaled))
    evidences = [compute_bin_evidence(correlation, scaled, own_noise.chi2, own_noise.degrees)]
    gram, right = bins.joined.T @ projected[:-1, :-1] @ bins.joined, bins.joined.T @ projected[:-1, -1]
    evidences.append(compute_bin_evidence(*_scale_informative(gram, right), joined_noise.chi2, joined_noise.degrees))
    gains, rests = (np.concatenate([getattr(each, name) for each in evidences]) for name in ("gains", "rests"))
    return OmnibusStatistic(chi2, len(scaled), own_noise.chi2, own_noise.degrees, BinEvidence(gains, rests))


def _select_joined(bins: Bins, used: IntArray) -> FloatArray:
    """Return the weights of some bins in the joined bins that they are in, [used, k]."""
    weights = bins.joined[used]
    return np.asarray(weights[:, weights.any(axis=0)])


def _compute_quadratic_form(gram: FloatArray, right: FloatArray) -> tuple[float, int]:
    """Return rightᵀ gram⁻¹ right and the number of informative bins."""
    correlation, scaled = _scale_informative(gram, right)
    return float(scaled @ cho_solve(cho_factor(correlation), scaled)), len(scaled)


def _scale_informative(gram: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the correlations of the informative bins, with a ridge, and their means in units of the noise."""
    scale = np.sqrt(np.diag(gram))
    is_informative = scale > 1e-9 * scale.max(initial=0.0)
    informative = np.flatnonzero(is_informative)
    scale = scale[informative]
    correlation = gram[np.ix_(informative, informative)] / scale / scale[:, None] + RIDGE * np.eye(len(informative))
    return correlation, right[informative] / scale


def compute_omnibus_by_group(problem: FitProblem, residual: FloatArray, sensitivity: JitterSensitivity) -> FloatArray:
    """Return χ² of a residual in each group's bins and its degrees of freedom, [groups, 2]."""
    data = problem.data
    out = []
    for runs in data.groups.values():
        group_data = data.select(runs)
        part = np.concatenate([np.arange(b.part.start, b.part.stop) for b in data.blocks if b.run in runs])
        group_sensitivity = JitterSensitivity(sensitivity.power[part], sensitivity.timing[part])
        statistic = compute_omnibus(replace(problem, data=group_data), residual[part][:, None], group_sensitivity)
        out.append((statistic.chi2, statistic.degrees))
    return np.array(out, dtype=np.float64)


def _list_bins(labels: IntArray) -> IntArray:
    return np.asarray(np.unique(labels[labels >= 0]))


def _find_bins(data: Dataset) -> Bins:
    """Return the bins of `assign_bins`, computed once for a dataset: every detection asks for them."""
    if data not in _known_bins:
        _known_bins[data] = assign_bins(data)
    return _known_bins[data]


def assign_bins(data: Dataset) -> Bins:
    """Return the bins: group × signal × pixel × (edge, logarithm of the time after it, time in the run).

    Joined ones: signal × pixel × (direction of the edge, train or not, logarithm of the time after it)
    """
    names: dict[tuple[object, ...], int] = {}
    joined_names: dict[tuple[object, ...], int] = {}
    joined: list[tuple[int, float]] = []
    max_span = {
        kind: max(float(np.ptp(data.value[b.part])) for b in data.blocks if b.kind == kind) for kind in data.kinds
    }
    label = np.full(len(data.value), -1, dtype=np.int64)
    for block in data.blocks:
        run = data.runs[block.run]
        edges_s, rising = _find_edges(run.pulses, run.commands if block.kind >= 3 else None)
        row = np.searchsorted(edges_s, block.t_s, side="right") - 1
        after_s = block.t_s - edges_s[np.maximum(row, 0)]
        edge_bin = np.searchsorted(EDGE_BINS_S, after_s)
        is_train = len(run.pulses) > 2
        span_s = max(float(block.t_s[-1] - block.t_s[0]), 1e-9)
        run_bin = (
            ((block.t_s - block.t_s[0]) / span_s * RUN_BINS).astype(int).clip(0, RUN_BINS - 1)
            if is_train
            else 0 * edge_bin
        )
        order = np.where(
            row < 0, -1, np.where(rising[np.maximum(row, 0)], 0, 1) + 2 * (0 if is_train else 1) * (row // 2)
        )
        weight = float(np.ptp(data.value[block.part])) / max(max_span[block.kind], 1e-300)
        joined_bin = np.searchsorted(JOINED_BINS_S, after_s)
        keys = zip(order.tolist(), edge_bin.tolist(), run_bin.tolist(), joined_bin.tolist(), strict=True)
        for at, (*key, joined_edge) in enumerate(keys, start=block.part.start):
            bin_key = (run.group, block.kind, block.pixel, *key)
            label[at] = names.setdefault(bin_key, len(names))
            if label[at] == len(joined):
                joined_key = (block.kind, block.pixel, is_train, min(key[0], key[0] % 2), joined_edge)
                joined.append((joined_names.setdefault(joined_key, len(joined_names)), weight))
    weights = np.zeros((len(joined), len(joined_names)))
    for number, (column, weight) in enumerate(joined):
        weights[number, column] = weight
    return Bins(label, weights)


def _find_edges(pulses: FloatArray, commands: FloatArray | None) -> tuple[FloatArray, np.ndarray]:
    if commands is not None:
        return commands[:, 0], np.arange(len(commands)) % 2 == 0
    edges_s = np.concatenate([pulses[:, 0], pulses[:, 0] + pulses[:, 1]])
    order = np.argsort(edges_s, kind="stable")
    rising = np.concatenate([np.ones(len(pulses), dtype=bool), np.zeros(len(pulses), dtype=bool)])
    if not len(edges_s):
        return np.zeros(1), np.ones(1, dtype=bool)
    return edges_s[order], rising[order]
