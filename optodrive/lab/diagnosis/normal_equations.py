"""Normal equations per run under the noise model, with the jitters of the run marginalised."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import Dataset
from optodrive.lab.diagnosis.noise_model import NoiseModel, whiten


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Gram matrices [runs, k, k] of k whitened columns with jitters marginalised."""

    gram: FloatArray

    @property
    def total(self) -> FloatArray:
        """Sum over runs, [k, k]."""
        return np.asarray(self.gram.sum(axis=0))


def compute_normal_equations(
    data: Dataset, columns: FloatArray, noise: NoiseModel, power: FloatArray, timing: FloatArray
) -> NormalEquations:
    """Compute the gram matrices of columns [m, k].

    power, timing: sensitivities [m] as in `JitterSensitivity`
    """
    kinds, count = data.kinds, columns.shape[1]
    size = 2 + len(kinds)
    grams = np.zeros((len(data.runs), count + size, count + size))
    for block in data.blocks:
        part, index = block.part, kinds.index(block.kind)
        jitters = np.zeros((part.stop - part.start, size))
        jitters[:, 0] = noise.power_sigma * power[part]
        jitters[:, 1] = noise.timing_sigma_s * timing[part]
        jitters[:, 2 + index] = noise.baseline_sigma[block.kind]
        whitened, _ = whiten(block.t_s, np.hstack([columns[part], jitters]), noise.coloured[block.kind])
        grams[block.run] += whitened.T @ whitened
    out = np.empty((len(data.runs), count, count))
    for run, gram in enumerate(grams):
        inner = gram[count:, count:] + np.eye(size)
        out[run] = gram[:count, :count] - gram[:count, count:] @ np.linalg.solve(inner, gram[count:, :count])
    return NormalEquations(out)


def solve(gram: FloatArray, right: FloatArray) -> FloatArray:
    """Return gram⁻¹ right, restricted to the well-conditioned directions of gram."""
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    correlation = gram / scale / scale[:, None]
    values, vectors = np.linalg.eigh(correlation)
    kept = values > 1e-9
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    return np.asarray(
        (inverse @ (right / scale if right.ndim == 1 else right / scale[:, None]))
        / (scale if right.ndim == 1 else scale[:, None])
    )


def solve_within(
    gram: FloatArray, right: FloatArray, lower: FloatArray, upper: FloatArray, damping: float = 0.0
) -> FloatArray:
    """Return the minimum of xᵀ gram x − 2 rightᵀ x for lower ≤ x ≤ upper, with gram's diagonal raised by a share.

    A solution that is clipped afterwards may increase the objective: the other numbers then do not fit the clipped one.
    """
    is_movable = upper > lower
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))[is_movable]
    correlation = gram[np.ix_(is_movable, is_movable)] / scale / scale[:, None] + (1e-9 + damping) * np.eye(len(scale))
    root = np.linalg.cholesky(correlation)
    target = np.linalg.solve(root, right[is_movable] / scale)
    scaled = np.linalg.solve(root.T, target)
    limits = (lower[is_movable] * scale, upper[is_movable] * scale)
    if ((scaled < limits[0]) | (scaled > limits[1])).any():
        scaled = lsq_linear(root.T, target, limits, method="bvls").x
    out = np.zeros(len(right))
    out[is_movable] = scaled / scale
    return np.clip(out, lower, upper)


def project_out(gram: FloatArray, removed: list[int], kept: list[int]) -> FloatArray:
    """Return the gram matrix of the columns `kept` orthogonal to the columns `removed`."""
    cross = gram[np.ix_(removed, kept)]
    return np.asarray(gram[np.ix_(kept, kept)] - cross.T @ solve(gram[np.ix_(removed, removed)], cross))
