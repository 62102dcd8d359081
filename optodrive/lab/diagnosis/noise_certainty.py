"""How well the noise is known where two explanations differ.

Theory of operation

The noise model is an estimate: of the jitters of power and timing and of the baselines from as many values as there are
repeats, some ten to twenty; of the samples' noise from thousands. A difference of χ² is worth as much as the noise that
it is measured by is known: an effect that looks like a change of the power is measured by the jitter of the power, one
within a pulse by the samples' noise. So each variance is changed alone, and the relative change of the difference is
its share. With the relative variances of these estimates, 2 / ν each, the difference has a relative variance of
Σ share² · 2 / ν, which is that of one variance known to ν degrees of freedom (after Satterthwaite).
"""

from dataclasses import replace
from math import exp

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, Dataset
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, compute_jitter_sensitivity, compute_normal_equations
from optodrive.lab.diagnosis.noise_model import NoiseModel

PRIOR_DEGREES, KNOWN_DEGREES = 6, 10_000
"""Degrees of freedom of what is known of jitters beforehand; degrees of freedom of noise that counts as known."""
MAX_DEGREES = 60
"""Largest number of degrees of freedom of estimated noise: terms are approximations, too."""
LOG_STEP = 0.1
"""Change of the logarithm of a variance."""


def count_noise_degrees(data: Dataset) -> int:
    """Return the degrees of freedom of the jitters.

    Mirror noise, raised above its estimate, counts as known.
    """
    mirrors = all(kind in MIRROR_KINDS for kind in data.kinds)
    return KNOWN_DEGREES if mirrors or not data.contrast_count else PRIOR_DEGREES + data.contrast_count


class NoiseCertainty:
    """Degrees of freedom of the noise by which fits differ from the best one."""

    def __init__(self, problem: FitProblem, best: ModelFit) -> None:
        self._problem = problem
        self._min_degrees = count_noise_degrees(problem.data)
        # Each change costs a whitening of all data; known noise needs none.
        changes = _list_changes(problem) if self._min_degrees < KNOWN_DEGREES else []
        self._noises = [problem.noise, *(noise for noise, _ in changes)]
        self._degrees = np.array([degrees for _, degrees in changes])
        self._best = self._compute_chi2(best)

    def count_degrees(self, other: ModelFit) -> float:
        """Return the degrees of freedom: those of the jitters at least, and where the fits do not differ."""
        differences = self._compute_chi2(other) - self._best
        # Fits that agree have no shares; the fewest degrees are the cautious answer.
        if not len(self._degrees) or differences[0] <= 0.0:
            return self._min_degrees
        shares = np.log(np.maximum(differences[1:] / differences[0], 1e-9)) / LOG_STEP
        variance = float((shares**2 * 2.0 / self._degrees).sum())
        return float(np.clip(2.0 / max(variance, 1e-9), self._min_degrees, max(MAX_DEGREES, self._min_degrees)))

    def _compute_chi2(self, fitted: ModelFit) -> FloatArray:
        """Return χ² of a fit, without priors, under the noise as it is and with each of its changes."""
        problem = self._problem
        residual = (problem.data.value - fitted.prediction)[:, None]
        jitter = compute_jitter_sensitivity(problem.data, fitted.point, fitted.prediction)
        equations = (
            compute_normal_equations(problem.data, residual, noise, jitter.power, jitter.timing)
            for noise in self._noises
        )
        return np.array([item.total[0, 0] for item in equations])


def _list_changes(problem: FitProblem) -> list[tuple[NoiseModel, float]]:
    """Return the noise with each of its variances changed alone, and the degrees of freedom of that one."""
    data, noise, factor = problem.data, problem.noise, exp(0.5 * LOG_STEP)
    jitter_degrees = count_noise_degrees(data)
    out: list[tuple[NoiseModel, float]] = [
        (replace(noise, power_sigma=factor * noise.power_sigma), jitter_degrees),
        (replace(noise, timing_sigma_s=factor * noise.timing_sigma_s), jitter_degrees),
    ]
    # Only differences between repeats tell the noise: of two runs, one.
    share = data.contrast_count / len(data.runs)
    for kind, coloured in noise.coloured.items():
        blocks = [block for block in data.blocks if block.kind == kind]
        samples = share * sum(len(block.t_s) for block in blocks)
        duration_s = share * sum(float(block.t_s[-1] - block.t_s[0]) for block in blocks)
        baseline = noise.baseline_sigma | {kind: factor * noise.baseline_sigma[kind]}
        out.append((replace(noise, baseline_sigma=baseline), jitter_degrees))
        first, second = coloured.sigma
        changes = (
            (replace(coloured, white=factor * coloured.white), samples),
            # Slow noise is known by as many values as correlation times fit in, not by samples.
            (replace(coloured, sigma=(factor * first, second)), duration_s / coloured.tau_s[0]),
            (replace(coloured, sigma=(first, factor * second)), duration_s / coloured.tau_s[1]),
        )
        out += [
            (replace(noise, coloured=noise.coloured | {kind: item}), max(jitter_degrees, min(degrees, samples)))
            for item, degrees in changes
        ]
    return out
