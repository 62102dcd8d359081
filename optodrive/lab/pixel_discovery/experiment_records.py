"""Records of a discovery from the runs of a recording: one per experiment, of the mean over its repeats.

Theory of operation. What is averaged are residuals of the nominal fit, in bins of time between two gate edges, over all
repeats; the nominal prediction at the middle of the bin is added again. A residual is smooth where a signal is not, so
bins widen with the time since the edge, and a long gap in the dark costs few samples. Gate edges are samples of their
own, without outputs, because light is held from one sample to the next.

Whitening. The covariance of a signal's bins is that of the diagnosis' noise model, averaged over the samples
of each bin and over the repeats; its Cholesky factor, in order of time, whitens one signal. Power, timing and zeros of
an experiment are known to the jitters over the root of the repeats: with N their whitened sensitivities, errors have
the covariance 1 + N Nᵀ, whose inverse root has the singular vectors of N.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, compute_jitter_sensitivity
from optodrive.lab.diagnosis.noise_model import ColouredNoise, NoiseModel
from optodrive.lab.diagnosis.prediction import EPSILON
from optodrive.lab.discovery import Record
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals

MIN_BIN_S = 2e-4
BIN_GROWTH = 0.08
"""Width of a bin per time since the gate edge before it."""
MAX_SAMPLES, FIRST_PULSES = 500, 10
"""Samples of a record above which bins are kept only of its first pulses and of one in two, four, eight… later ones."""
NEAR = 0.1
"""Share of a bin within which mean times of two signals count as one."""

Repeats = list[tuple[PixelExperiment, tuple[int, int, int]]]
"""Runs of one experiment with the numbers of their blocks by kind of signal, −1 where it was not measured."""


@dataclass(frozen=True, eq=False)
class _Grid:
    """Times [m] of a record with its inputs [m, 4].

    begin_s, end_s: of each bin [b]; rows: of each bin in each signal [b, 3]. A signal's samples in a bin stand at their
    mean time, which is a row of its own where another signal's is not near.
    """

    t_s: FloatArray
    inputs: FloatArray
    begin_s: FloatArray
    end_s: FloatArray
    rows: IntArray

    def find_rows(self, t_s: FloatArray, kind: int) -> IntArray:
        """Return the row in which each sample of a kind of signal counts, −1 where it lies in no bin."""
        found = np.maximum(np.searchsorted(self.begin_s, t_s, side="right") - 1, 0)
        is_inside = (t_s >= self.begin_s[found]) & (t_s < self.end_s[found])
        return np.asarray(np.where(is_inside, self.rows[found, kind], -1))


def build_records(problem: FitProblem, base: ModelFit) -> list[Record]:
    """Return the records of all experiments that light the measured pixel and no other."""
    data = problem.data
    experiments: dict[tuple[str, int], Repeats] = {}
    for experiment, numbers in data.experiments:
        run = data.blocks[max(numbers)].run
        if len(experiment.pulses) and (experiment.pulses[:, 3] == experiment.pixel).all():
            experiments.setdefault((data.runs[run].group, experiment.pixel), []).append((experiment, numbers))
    sensitivity = compute_jitter_sensitivity(data, base.point, base.prediction)
    columns = np.column_stack([data.value - base.prediction, sensitivity.power, sensitivity.timing])
    return [
        replace(_build_record(repeats, problem, base, columns), name=name) for (name, _), repeats in experiments.items()
    ]


def _build_record(repeats: Repeats, problem: FitProblem, base: ModelFit, columns: FloatArray) -> Record:
    """Return the record of an experiment.

    columns: [samples of the data, 3], residual and sensitivities to power and timing
    """
    data, first = problem.data, repeats[0][0]
    blocks = [[data.blocks[numbers[kind]] for _, numbers in repeats if numbers[kind] >= 0] for kind in PIXEL_KINDS]
    samples_s = [np.sort(np.concatenate([block.t_s for block in own] or [np.zeros(0)])) for own in blocks]
    finest_s = min(float(np.median(np.diff(block.t_s))) for own in blocks for block in own)
    grid = _build_grid(first, samples_s, max(MIN_BIN_S, finest_s))
    nominal = simulate_signals(
        PixelExperiment(first.pulses, first.pixel, first.ambient_k, (grid.t_s,) * 3, full_w=first.full_w),
        base.point.pixel(),
        ActiveTerms.from_values(base.point.terms),
    )
    outputs = np.full((len(grid.t_s), len(PIXEL_KINDS)), np.nan)
    signals: list[BinnedSignal] = []
    for kind in PIXEL_KINDS:
        if not blocks[kind]:
            continue
        places = grid.find_rows(np.concatenate([block.t_s for block in blocks[kind]]), kind)
        rows, place, counts = np.unique(places[places >= 0], return_inverse=True, return_counts=True)
        values = np.concatenate([columns[block.part] for block in blocks[kind]])[places >= 0]
        means = np.column_stack([np.bincount(place, column) / counts for column in values.T])
        outputs[rows, kind] = nominal[kind][rows] + means[:, 0]
        densest = max(blocks[kind], key=lambda block: len(block.t_s)).t_s
        densest = densest[grid.find_rows(densest, kind) >= 0]
        lonely = np.setdiff1d(rows, grid.find_rows(densest, kind))  # samples that the densest repeat misses
        sampled_s = np.sort(np.concatenate([densest, grid.t_s[lonely]]))
        sampled_rows = grid.find_rows(sampled_s, kind)
        signals.append(BinnedSignal(kind, rows, counts, sampled_s, sampled_rows, len(blocks[kind]), means[:, 1:]))
    return Record(grid.t_s, grid.inputs, outputs, build_whitening(signals, problem.noise))


def _build_grid(experiment: PixelExperiment, samples_s: Sequence[FloatArray], first_bin_s: float) -> _Grid:
    """Return the grid of an experiment, for sorted sample times of each kind of signal."""
    kept = 1
    while True:
        grid = _divide(experiment, samples_s, first_bin_s, kept)
        if len(grid.t_s) <= MAX_SAMPLES or kept > len(experiment.pulses):
            return grid
        kept *= 2


def _divide(experiment: PixelExperiment, samples_s: Sequence[FloatArray], first_bin_s: float, kept: int) -> _Grid:
    """Return the grid with the bins of the first pulses and of one in `kept` later ones."""
    rows, bins = list[tuple[float, ...]](), list[tuple[float, float, list[int]]]()
    gates = [(0.0, 0.0, 0.0)]  # begin, light, light of the pulse before
    for start_s, width_s, power_w, _ in experiment.pulses.tolist():
        gates += [(start_s, EPSILON * power_w, 0.0), (start_s + width_s, 0.0, EPSILON * power_w)]
    for number, (begin_s, light_w, after_w) in enumerate(gates):
        is_last, pulse = number + 1 == len(gates), (number - 1) // 2
        end_s = max(float(t_s[-1]) for t_s in samples_s if len(t_s)) + 1e-6 if is_last else gates[number + 1][0]
        if end_s - begin_s < 1e-9:
            continue
        inputs = (light_w, after_w, begin_s if light_w > 0.0 else 0.0, begin_s if after_w > 0.0 else 0.0)
        rows.append((begin_s, *inputs))
        left_s = begin_s if pulse < FIRST_PULSES or pulse % kept == 0 or is_last else end_s
        while left_s < end_s - 1e-9:
            right_s = left_s + max(first_bin_s, BIN_GROWTH * (left_s - begin_s))
            right_s = end_s if right_s + first_bin_s > end_s else right_s
            times_s, places = _place_samples(samples_s, left_s, right_s)
            bins.append((left_s, right_s, [place + len(rows) if place >= 0 else -1 for place in places]))
            rows += [(time_s, *inputs) for time_s in times_s]
            left_s = right_s
    table, edges_s = np.array(rows), np.array([(left_s, right_s) for left_s, right_s, _ in bins])
    places_of = np.array([places for _, _, places in bins])
    return _Grid(table[:, 0], np.ascontiguousarray(table[:, 1:]), edges_s[:, 0], edges_s[:, 1], places_of)


def _place_samples(samples_s: Sequence[FloatArray], left_s: float, right_s: float) -> tuple[list[float], list[int]]:
    """Return the times of a bin's rows, and the number of each signal's, −1 without a sample."""
    means_s = dict[int, float]()
    for kind, t_s in enumerate(samples_s):
        first, last = np.searchsorted(t_s, [left_s, right_s])
        if last > first:
            means_s[kind] = float(t_s[first:last].mean())
    times_s, places = list[float](), [-1] * len(samples_s)
    for kind in sorted(means_s, key=lambda kind: means_s[kind]):
        if not times_s or means_s[kind] - times_s[-1] > NEAR * (right_s - left_s):
            times_s.append(max(means_s[kind], left_s + 1e-9))
        places[kind] = len(times_s) - 1
    return times_s, places


@dataclass(frozen=True, eq=False)
class BinnedSignal:
    """Bins of one signal of a record.

    rows: [b] of the record; counts: [b] of samples over all repeats; sampled_s, sampled_rows: times of the samples of
    one repeat and the rows of their bins, in order; repeats: number of repeats; sensitivities: [b, 2] to the relative
    power and to a delay, per second
    """

    kind: int
    rows: IntArray
    counts: IntArray
    sampled_s: FloatArray
    sampled_rows: IntArray
    repeats: int
    sensitivities: FloatArray


def build_whitening(signals: Sequence[BinnedSignal], noise: NoiseModel) -> Callable[[FloatArray], FloatArray]:
    """Return the map of errors [m, 3, k] of a record to errors of independent noise of one."""
    inverses = [
        np.linalg.inv(np.linalg.cholesky(_compute_covariance(each, noise.coloured[each.kind]))) for each in signals
    ]

    def whiten_signals(errors: FloatArray) -> FloatArray:
        out = np.zeros(errors.shape)
        for each, inverse in zip(signals, inverses, strict=True):
            out[each.rows, each.kind] = inverse @ errors[each.rows, each.kind]
        return out

    size = 1 + max(int(each.rows.max()) for each in signals)
    jitters = np.zeros((size, len(PIXEL_KINDS), 2 + len(PIXEL_KINDS)))
    for each in signals:
        share = 1.0 / np.sqrt(each.repeats)
        jitters[each.rows, each.kind, 0] = share * noise.power_sigma * each.sensitivities[:, 0]
        jitters[each.rows, each.kind, 1] = share * noise.timing_sigma_s * each.sensitivities[:, 1]
        jitters[each.rows, each.kind, 2 + each.kind] = share * noise.baseline_sigma[each.kind]
    vectors, sizes, _ = np.linalg.svd(
        whiten_signals(jitters).reshape(size * len(PIXEL_KINDS), jitters.shape[2]), full_matrices=False
    )
    taken = vectors * (1.0 - 1.0 / np.sqrt(1.0 + sizes**2))

    def whiten(errors: FloatArray) -> FloatArray:
        out = whiten_signals(errors)
        head = out[:size].reshape(size * len(PIXEL_KINDS), -1)
        out[:size] = (head - taken @ (vectors.T @ head)).reshape(size, *out.shape[1:])
        return out

    return whiten


def _compute_covariance(signal: BinnedSignal, noise: ColouredNoise) -> FloatArray:
    """Return the covariance [b, b] of the means over bins."""
    apart_s = np.abs(signal.sampled_s[:, None] - signal.sampled_s[None, :])
    coloured = noise.sigma[0] ** 2 * np.exp(-apart_s / noise.tau_s[0])
    coloured += noise.sigma[1] ** 2 * np.exp(-apart_s / noise.tau_s[1]) * np.cos(noise.omega_rad_per_s * apart_s)
    _, begins, counts = np.unique(signal.sampled_rows, return_index=True, return_counts=True)
    means = np.add.reduceat(np.add.reduceat(coloured, begins, axis=0), begins, axis=1) / np.outer(counts, counts)
    white = [noise.compute_mean_variance(signal.sampled_s, count) for count in signal.counts.tolist()]
    return np.asarray(means / signal.repeats + np.diag(white))
