"""Before anything is named: the noise model, from repeats, and the nominal model fitted under it."""

from dataclasses import replace

import numpy as np

from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, Dataset
from optodrive.lab.diagnosis.fitting import Fit, Prior, Problem, fit, jitter
from optodrive.lab.diagnosis.noise_model import Coloured, NoiseModel, estimate
from optodrive.lab.diagnosis.power_fluctuation import unsteadiness
from optodrive.lab.diagnosis.prediction import Point

EPSILON = 0.66
BROAD = Prior((np.log(150.0), np.log(101e-6), np.log(3e-3), np.log(4e-6), np.log(2.3e-4)), (0.7, 0.16, 0.5, 0.5, 0.5))
"""The whole of Table S3; gas and membrane as the paper's peaks have them."""
MIRROR_SHARE = 1e-3
STARTS_R = (100.0, 180.0, 320.0)


def prepare(
    data: Dataset, prior: Prior = BROAD, epsilon: float = EPSILON, timing_s: float = 0.0, late_s: float = 0.0
) -> tuple[Problem, Fit]:
    """Noise model and base fit.

    timing_s: the runs' timing jitter at least, known from other signals; late_s: all clocks late, likewise
    """
    crude = _crude(data)
    clocks = ("temperature", "displacement", "force", "mirrors")
    known = {"clock_offset": dict.fromkeys(clocks, late_s)} if late_s else {}
    problem = Problem(data, crude, prior, epsilon)
    tries = [fit(problem, Point((float(np.log(r)), *prior.mean[1:]), known), iterations=3) for r in STARTS_R]
    base = fit(problem, min(tries, key=lambda item: item.chi2).point, iterations=10)
    problem = with_noise(problem, base, timing_s)
    base = fit(problem, base.point)
    return replace(problem, noise=replace(problem.noise, unsteady=unsteadiness(problem, base))), base


def with_noise(problem: Problem, fitted: Fit, timing_s: float) -> Problem:
    """The same with the noise that repeats show, jitters acting along the slopes of this fit."""
    data = problem.data
    shared = jitter(data, fitted.point, problem.epsilon, fitted.prediction)
    noise = estimate(data, data.value - fitted.prediction, shared.power, shared.timing)
    noise = replace(noise, timing_s=max(noise.timing_s, timing_s), coloured=_believable(data, noise.coloured))
    return replace(problem, noise=noise)


def _believable(data: Dataset, coloured: dict[int, Coloured]) -> dict[int, Coloured]:
    """Mirrors are read so finely that jitter bends their steps: no servo is believed beyond a share of its range."""
    out = dict(coloured)
    for kind in MIRROR_KINDS:
        if kind in out:
            span = float(np.ptp(np.concatenate([data.value[b.part] for b in data.blocks if b.kind == kind])))
            out[kind] = replace(out[kind], white=float(np.hypot(out[kind].white, MIRROR_SHARE * span)))
    return out


def _crude(data: Dataset) -> NoiseModel:
    coloured, baseline = {}, {}
    for kind in data.kinds():
        blocks = [block for block in data.blocks if block.kind == kind]
        steps = np.concatenate([np.diff(data.value[block.part]) for block in blocks])
        span = float(np.ptp(np.concatenate([data.value[block.part] for block in blocks])))
        white = float(np.median(np.abs(steps))) + 1e-3 * span + 1e-15
        coloured[kind] = Coloured(white, (white, white), (1e-2, 1.0))
        baseline[kind] = 3.0 * white
    return NoiseModel(coloured, 0.01, 5e-5, baseline, False)
