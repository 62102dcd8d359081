"""Generalised least squares: the nominal parameters, and free numbers of terms, under the noise model and priors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import Dataset
from optodrive.lab.diagnosis.hypotheses import Free
from optodrive.lab.diagnosis.noise_model import NoiseModel
from optodrive.lab.diagnosis.normal_equations import normal, solve
from optodrive.lab.diagnosis.prediction import BASE, Point, predict

BASE_STEP = 1e-3
BASE_SPAN = 1.8
"""Logarithm of the factor by which a base parameter may leave its prior: a gas ever quicker would take ever longer."""
POWER_STEP, LATE_STEP_S = 5e-3, 1e-5
ENOUGH = 0.02
"""A step that promises less χ² than this is the last."""


@dataclass(frozen=True)
class Prior:
    """Of the logarithms of the base parameters."""

    mean: tuple[float, ...]
    sigma: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Jitter:
    """[m] each: the prediction's change with the logarithm of the power, and with a delay, per second."""

    power: FloatArray
    timing: FloatArray


@dataclass(frozen=True, eq=False)
class Fit:
    """chi2: with priors; covariance: of base then free, as fitted; gram: [runs, k + 1, k + 1], the residual last."""

    point: Point
    free: tuple[Free, ...]
    chi2: float
    covariance: FloatArray
    gram: FloatArray
    prediction: FloatArray


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything that stays while models are fitted."""

    data: Dataset
    noise: NoiseModel
    prior: Prior
    epsilon: float


def jitter(data: Dataset, point: Point, epsilon: float, prediction: FloatArray) -> Jitter:
    """By differences."""
    stronger = predict(data, point, epsilon, power=1.0 + POWER_STEP)
    later = predict(data, point, epsilon, late_s=LATE_STEP_S)
    sooner = predict(data, point, epsilon, late_s=-LATE_STEP_S)
    return Jitter((stronger - prediction) / np.log1p(POWER_STEP), 0.5 * (later - sooner) / LATE_STEP_S)


def moved(problem: Problem, point: Point, free: Sequence[Free], step: FloatArray) -> Point:
    """The point after a step in base and free numbers, within their ranges."""
    centre = np.array(problem.prior.mean)
    reached = np.add(point.base, np.clip(step[: len(BASE)], -0.5, 0.5))
    base = tuple(np.clip(reached, centre - BASE_SPAN, centre + BASE_SPAN).tolist())
    terms: Mapping[str, Mapping[str, float]] = point.terms
    for item, change in zip(free, step[len(BASE) :], strict=True):
        number = item.read(terms)
        most = 1.0 if item.logarithmic else 0.5 * (item.parameter.high - item.parameter.low)
        terms = item.written(terms, number + float(np.clip(change, -most, most)))
    return Point(base, terms)


def slopes(problem: Problem, point: Point, free: Sequence[Free], prediction: FloatArray) -> FloatArray:
    """[m, k] derivatives with base and free numbers."""
    columns = np.empty((len(prediction), len(BASE) + len(free)))
    for row in range(len(BASE)):
        base = list(point.base)
        base[row] += BASE_STEP
        near = replace(point, base=tuple(base))
        columns[:, row] = (predict(problem.data, near, problem.epsilon) - prediction) / BASE_STEP
    for row, item in enumerate(free):
        number = item.read(point.terms)
        for step in (item.step, -item.step):
            terms = item.written(point.terms, number + step)
            change = item.read(terms) - number
            if change != 0.0:
                break
        near = replace(point, terms=terms)
        columns[:, len(BASE) + row] = (predict(problem.data, near, problem.epsilon) - prediction) / change
    return columns


def fit(
    problem: Problem, point: Point, free: Sequence[Free] = (), iterations: int = 12, hopeless: float = np.inf
) -> Fit:
    """From a point to the nearest minimum, by Gauss–Newton with shorter steps where one was too long.

    hopeless: a χ² that it must promise to come below to be worth going on, from the second step on.
    """
    data, count = problem.data, len(BASE) + len(free)
    prediction = predict(data, point, problem.epsilon)
    shared = jitter(data, point, problem.epsilon, prediction)
    precision = np.concatenate([1.0 / np.square(problem.prior.sigma), np.zeros(len(free))])
    centre = np.concatenate([problem.prior.mean, np.zeros(len(free))])
    best: Fit | None = None
    step, tried = np.zeros(count), point
    left = iterations
    while best is None or left > 0:
        left -= 1
        off = np.concatenate([tried.base, np.zeros(len(free))]) - centre
        residual = (data.value - prediction)[:, None]
        cost = float(normal(data, residual, problem.noise, shared.power, shared.timing).total()[0, 0])
        cost += float(precision @ off**2)
        if best is not None and not cost <= best.chi2 - 1e-9:
            step = 0.3 * step
            if float(np.abs(step).max()) < 1e-4:
                break
        else:
            gained = np.inf if best is None else best.chi2 - cost
            columns = np.column_stack([slopes(problem, tried, free, prediction), residual])
            gram = normal(data, columns, problem.noise, shared.power, shared.timing).gram
            total = gram.sum(axis=0)
            covariance = solve(total[:count, :count] + np.diag(precision), np.eye(count))
            right = total[:count, -1] - precision * off
            best = Fit(tried, tuple(free), cost, covariance, gram, prediction)
            step = covariance @ right
            promised = float(right @ step)
            if min(promised, gained) < ENOUGH or (gained < np.inf and cost - 2.0 * promised > hopeless):
                break
        tried = moved(problem, best.point, free, step)
        prediction = predict(data, tried, problem.epsilon)
    return best
