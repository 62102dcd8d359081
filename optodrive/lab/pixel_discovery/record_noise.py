"""Whitening of a record's errors: coloured noise of means over bins, and jitters common to an experiment.

Theory of operation. The covariance of a signal's bins is that of the diagnosis' noise model, averaged over the samples
of each bin and over the repeats; its Cholesky factor, in order of time, whitens one signal. Power, timing and zeros of
an experiment are known to the jitters over the root of the repeats: with N their whitened sensitivities, errors have
the covariance 1 + N Nᵀ, whose inverse root has the singular vectors of N.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS
from optodrive.lab.diagnosis.noise_model import ColouredNoise, NoiseModel


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
