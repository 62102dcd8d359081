"""Generalised least squares for base parameters and free term parameters under the noise model and priors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import Dataset
from optodrive.lab.diagnosis.noise_model import NoiseModel
from optodrive.lab.diagnosis.normal_equations import compute_normal_equations, solve
from optodrive.lab.diagnosis.prediction import BASE_PARAMETERS, ParameterPoint, predict
from optodrive.physics.hypothesis import FreeParameter

BASE_LOG_STEP = 1e-3
BASE_LOG_SPAN = 1.8
"""Maximum deviation of a base parameter's logarithm from its prior; a very short gas time constant costs many steps."""
POWER_STEP, DELAY_STEP_S = 5e-3, 1e-5
CHI2_CONVERGED = 0.02
"""Predicted or achieved decrease of χ² below which the iteration ends."""


@dataclass(frozen=True)
class BaseParameterPrior:
    """Normal prior of the logarithms of the base parameters."""

    mean: tuple[float, ...]
    sigma: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class JitterSensitivity:
    """Derivatives of the prediction [m] with respect to the logarithm of the power and to a delay, per second."""

    power: FloatArray
    timing: FloatArray


@dataclass(frozen=True, eq=False)
class ModelFit:
    """Result of a fit.

    chi2: with priors; covariance: of base, then free parameters; gram: [runs, k + 1, k + 1], the residual last
    """

    point: ParameterPoint
    free: tuple[FreeParameter, ...]
    chi2: float
    covariance: FloatArray
    gram: FloatArray
    prediction: FloatArray


@dataclass(frozen=True, eq=False)
class FitProblem:
    """Data, noise model and prior of a fit."""

    data: Dataset
    noise: NoiseModel
    prior: BaseParameterPrior
    epsilon: float


def compute_jitter_sensitivity(
    data: Dataset, point: ParameterPoint, epsilon: float, prediction: FloatArray
) -> JitterSensitivity:
    """Compute the sensitivities to power and timing by finite differences."""
    more_power = predict(data, point, epsilon, power_factor=1.0 + POWER_STEP)
    later = predict(data, point, epsilon, delay_s=DELAY_STEP_S)
    earlier = predict(data, point, epsilon, delay_s=-DELAY_STEP_S)
    return JitterSensitivity((more_power - prediction) / np.log1p(POWER_STEP), 0.5 * (later - earlier) / DELAY_STEP_S)


def apply_step(
    problem: FitProblem, point: ParameterPoint, free: Sequence[FreeParameter], step: FloatArray
) -> ParameterPoint:
    """Return the point after a step in base and free parameters, clipped to their ranges."""
    centre = np.array(problem.prior.mean)
    stepped = np.add(point.base, np.clip(step[: len(BASE_PARAMETERS)], -0.5, 0.5))
    base = tuple(np.clip(stepped, centre - BASE_LOG_SPAN, centre + BASE_LOG_SPAN).tolist())
    terms: Mapping[str, Mapping[str, float]] = point.terms
    for item, change in zip(free, step[len(BASE_PARAMETERS) :], strict=True):
        number = item.read_value(terms)
        max_change = 1.0 if item.logarithmic else 0.5 * (item.parameter.high - item.parameter.low)
        terms = item.with_value(terms, number + float(np.clip(change, -max_change, max_change)))
    return ParameterPoint(base, terms)


def compute_jacobian(
    problem: FitProblem, point: ParameterPoint, free: Sequence[FreeParameter], prediction: FloatArray
) -> FloatArray:
    """Compute derivatives [m, k] with respect to base and free parameters by finite differences."""
    columns = np.empty((len(prediction), len(BASE_PARAMETERS) + len(free)))
    for row in range(len(BASE_PARAMETERS)):
        base = list(point.base)
        base[row] += BASE_LOG_STEP
        shifted = replace(point, base=tuple(base))
        columns[:, row] = (predict(problem.data, shifted, problem.epsilon) - prediction) / BASE_LOG_STEP
    for row, item in enumerate(free):
        number = item.read_value(point.terms)
        for step in (item.step, -item.step):
            terms = item.with_value(point.terms, number + step)
            change = item.read_value(terms) - number
            if change != 0.0:
                break
        shifted = replace(point, terms=terms)
        columns[:, len(BASE_PARAMETERS) + row] = (predict(problem.data, shifted, problem.epsilon) - prediction) / change
    return columns


def fit(
    problem: FitProblem,
    point: ParameterPoint,
    free: Sequence[FreeParameter] = (),
    iterations: int = 12,
    chi2_abandon: float = np.inf,
) -> ModelFit:
    """Minimise χ² from a point by Gauss–Newton with step reduction.

    chi2_abandon: from the second step on, the fit ends early if its predicted χ² stays above this value.
    """
    data, count = problem.data, len(BASE_PARAMETERS) + len(free)
    prediction = predict(data, point, problem.epsilon)
    sensitivity = compute_jitter_sensitivity(data, point, problem.epsilon, prediction)
    precision = np.concatenate([1.0 / np.square(problem.prior.sigma), np.zeros(len(free))])
    centre = np.concatenate([problem.prior.mean, np.zeros(len(free))])
    best: ModelFit | None = None
    step, trial = np.zeros(count), point
    remaining = iterations
    while best is None or remaining > 0:
        remaining -= 1
        deviation = np.concatenate([trial.base, np.zeros(len(free))]) - centre
        residual = (data.value - prediction)[:, None]
        cost = float(
            compute_normal_equations(data, residual, problem.noise, sensitivity.power, sensitivity.timing).total[0, 0]
        )
        cost += float(precision @ deviation**2)
        if best is not None and not cost <= best.chi2 - 1e-9:
            step = 0.3 * step
            if float(np.abs(step).max()) < 1e-4:
                break
        else:
            improvement = np.inf if best is None else best.chi2 - cost
            columns = np.column_stack([compute_jacobian(problem, trial, free, prediction), residual])
            gram = compute_normal_equations(data, columns, problem.noise, sensitivity.power, sensitivity.timing).gram
            total = gram.sum(axis=0)
            covariance = solve(total[:count, :count] + np.diag(precision), np.eye(count))
            gradient = total[:count, -1] - precision * deviation
            best = ModelFit(trial, tuple(free), cost, covariance, gram, prediction)
            step = covariance @ gradient
            predicted_improvement = float(gradient @ step)
            if min(predicted_improvement, improvement) < CHI2_CONVERGED or (
                improvement < np.inf and cost - 2.0 * predicted_improvement > chi2_abandon
            ):
                break
        trial = apply_step(problem, best.point, free, step)
        prediction = predict(data, trial, problem.epsilon)
    return best
