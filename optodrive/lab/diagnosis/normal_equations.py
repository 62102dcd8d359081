"""Normal equations run by run: columns against each other under the noise model, what a run shares taken out."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import Dataset
from optodrive.lab.diagnosis.noise_model import NoiseModel, whiten


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """gram: [runs, k, k] of k columns, whitened, jitters of the run marginalised."""

    gram: FloatArray

    @property
    def total(self) -> FloatArray:
        """[k, k]."""
        return np.asarray(self.gram.sum(axis=0))


def compute_normal_equations(
    data: Dataset, columns: FloatArray, noise: NoiseModel, power: FloatArray, timing: FloatArray
) -> NormalEquations:
    """Of columns [m, k]; power, timing: [m] as for `noise.estimate`."""
    kinds, count = data.kinds, columns.shape[1]
    size = 2 + len(kinds)
    grams = np.zeros((len(data.runs), count + size, count + size))
    for block in data.blocks:
        part, place = block.part, kinds.index(block.kind)
        jitters = np.zeros((part.stop - part.start, size))
        jitters[:, 0] = noise.power_sigma * power[part]
        jitters[:, 1] = noise.timing_sigma_s * timing[part]
        jitters[:, 2 + place] = noise.baseline_sigma[block.kind]
        whitened, _ = whiten(block.t_s, np.hstack([columns[part], jitters]), noise.coloured[block.kind])
        grams[block.run] += whitened.T @ whitened
    out = np.empty((len(data.runs), count, count))
    for run, gram in enumerate(grams):
        inner = gram[count:, count:] + np.eye(size)
        out[run] = gram[:count, :count] - gram[:count, count:] @ np.linalg.solve(inner, gram[count:, :count])
    return NormalEquations(out)


def solve(gram: FloatArray, right: FloatArray) -> FloatArray:
    """gram⁻¹ right, with columns that mean nothing here set aside."""
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    correlation = gram / scale / scale[:, None]
    values, vectors = np.linalg.eigh(correlation)
    kept = values > 1e-9
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    return np.asarray(
        (inverse @ (right / scale if right.ndim == 1 else right / scale[:, None]))
        / (scale if right.ndim == 1 else scale[:, None])
    )


def project_out(gram: FloatArray, removed: list[int], kept: list[int]) -> FloatArray:
    """What is left of the columns `kept` beside those in `out`: their gram."""
    cross = gram[np.ix_(removed, kept)]
    return np.asarray(gram[np.ix_(kept, kept)] - cross.T @ solve(gram[np.ix_(removed, removed)], cross))
