"""Noise model from repeats, and the nominal model fitted under it."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, Dataset
from optodrive.lab.diagnosis.fitting import BaseParameterPrior, FitProblem, ModelFit, compute_jitter_sensitivity, fit
from optodrive.lab.diagnosis.noise_model import ColouredNoise, NoiseModel, estimate_noise_model
from optodrive.lab.diagnosis.power_fluctuation import compute_intra_pulse_power_excess
from optodrive.lab.diagnosis.prediction import ParameterPoint
from optodrive.physics.term import TermValues

BROAD_PRIOR = BaseParameterPrior(
    (np.log(150.0), np.log(101e-6), np.log(3e-3), np.log(4e-6), np.log(2.3e-4)), (0.7, 0.16, 0.5, 0.5, 0.5)
)
"""Prior over the whole of Table S3; gas and membrane from the peak values in the paper."""
MIRROR_NOISE_FRACTION = 1e-3
R_STARTS_K_PER_W = (100.0, 180.0, 320.0)


def fit_nominal(
    data: Dataset,
    prior: BaseParameterPrior = BROAD_PRIOR,
    min_timing_sigma_s: float = 0.0,
    shared: Mapping[str, TermValues] | None = None,
) -> tuple[FitProblem, ModelFit]:
    """Estimate the noise model and fit the nominal model.

    min_timing_sigma_s: lower limit of the timing jitter, from other signals; shared: known terms of the clock
    that all signals share
    """
    # The noise needs the jitters' sensitivities, these a fit, and a fit some noise.
    crude_noise = _estimate_crude_noise(data)
    problem = FitProblem(data, crude_noise, prior)
    trials = [
        fit(problem, ParameterPoint((float(np.log(r)), *prior.mean[1:]), shared or {}), iterations=3)
        # From one start the fit may end with a wrong pair of R and C, of equal time constant.
        for r in R_STARTS_K_PER_W
    ]
    base = fit(problem, min(trials, key=lambda item: item.chi2).point, iterations=10)
    problem = update_noise(problem, base, min_timing_sigma_s)
    base = fit(problem, base.point)
    return replace(
        problem, noise=replace(problem.noise, intra_pulse_power_excess=compute_intra_pulse_power_excess(problem, base))
    ), base


def update_noise(problem: FitProblem, fitted: ModelFit, min_timing_sigma_s: float) -> FitProblem:
    """Return the problem with the noise model estimated from repeats, with jitter sensitivities at this fit."""
    data = problem.data
    sensitivity = compute_jitter_sensitivity(data, fitted.point, fitted.prediction)
    noise = estimate_noise_model(data, data.value - fitted.prediction, sensitivity.power, sensitivity.timing)
    noise = replace(
        noise,
        timing_sigma_s=max(noise.timing_sigma_s, min_timing_sigma_s),
        coloured=_raise_mirror_noise(data, noise.coloured),
    )
    return replace(problem, noise=noise)


def _raise_mirror_noise(data: Dataset, coloured: dict[int, ColouredNoise]) -> dict[int, ColouredNoise]:
    """Raise the white noise of mirror signals to a share of their range: jitter is nonlinear at mirror steps."""
    out = dict(coloured)
    for kind in MIRROR_KINDS:
        if kind in out:
            span = float(np.ptp(np.concatenate([data.value[b.part] for b in data.blocks if b.kind == kind])))
            # A mirror at rest is measured so precisely that the model of its servo would have to be exact.
            out[kind] = replace(out[kind], white=float(np.hypot(out[kind].white, MIRROR_NOISE_FRACTION * span)))
    return out


def _estimate_crude_noise(data: Dataset) -> NoiseModel:
    coloured, baseline = {}, {}
    for kind in data.kinds:
        blocks = [block for block in data.blocks if block.kind == kind]
        steps = np.concatenate([np.diff(data.value[block.part]) for block in blocks])
        span = float(np.ptp(np.concatenate([data.value[block.part] for block in blocks])))
        white = float(np.median(np.abs(steps))) + 1e-3 * span + 1e-15
        coloured[kind] = ColouredNoise(white, (white, white), (1e-2, 1.0))
        baseline[kind] = 3.0 * white
    return NoiseModel(coloured, 0.01, 5e-5, baseline, False)
