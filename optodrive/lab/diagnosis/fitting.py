"""Generalised least squares for base parameters and free term parameters under the noise model and priors.

The normal equations are those of each run under the noise model, with the jitters of the run marginalised.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from optodrive.core.errors import DivergedError, Unquoted
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS, Block, Dataset
from optodrive.lab.diagnosis.noise_model import NoiseModel, whiten
from optodrive.lab.diagnosis.prediction import BASE_PARAMETERS, ParameterPoint, predict
from optodrive.lab.diagnosis.replicate_contrasts import JitterSensitivity
from optodrive.physics.hypothesis import FreeParameter

BASE_LOG_STEP = 1e-3
MOVED_AS_ONE = (("R",), ("C",), ("tau_g",), ("kappa", "phi"))
"""Base parameters whose derivatives one prediction shows: those of one entry act on different signals."""
_, DISPLACEMENT, FORCE = PIXEL_KINDS
ACTS_ON = dict.fromkeys(BASE_PARAMETERS, PIXEL_KINDS) | {"kappa": (DISPLACEMENT,), "phi": (FORCE,)}
"""Kinds of signal on which each base parameter acts."""
BASE_LOG_SPAN = 1.8
"""Maximum deviation of a base parameter's logarithm from its prior; a very short gas time constant costs many steps."""
POWER_STEP, DELAY_STEP_S = 5e-3, 1e-5
MAX_ITERATIONS = 60
"""Most fits end within 10 steps; creep with a spread of times has a curved valley that takes 20 to 50."""
MIN_DAMPING, DAMPING_INCREASE, DAMPING_DECREASE = 1e-3, 4.0, 5.0
"""Damping of the first step after one that increased χ², relative to the curvature, and its changes."""
CHI2_CONVERGED = 0.02
"""Predicted or achieved decrease of χ² below which the iteration ends."""


def compute_normal_equations(
    data: Dataset, columns: FloatArray, noise: NoiseModel, sensitivity: JitterSensitivity
) -> FloatArray:
    """Return the gram matrix [k, k] of k whitened columns [m, k], with the jitters of each run marginalised."""
    count, kinds = columns.shape[1], data.kinds
    places, total = np.arange(count), np.zeros((count, count))
    for blocks in data.run_blocks:
        parts = [(block, columns[block.part], places) for block in blocks]
        total += reduce_run(parts, count, kinds, noise, sensitivity)
    return total


def reduce_run(
    parts: Iterable[tuple[Block, FloatArray, IntArray]],
    count: int,
    kinds: list[int],
    noise: NoiseModel,
    sensitivity: JitterSensitivity,
) -> FloatArray:
    """Return the gram matrix [count, count] of the whitened columns of one run, its jitters marginalised.

    parts: blocks of the run with their columns and the numbers of these
    """
    size = 2 + len(kinds)
    gram = np.zeros((count + size, count + size))
    for block, columns, places in parts:
        jitters = [
            noise.power_sigma * sensitivity.power[block.part],
            noise.timing_sigma_s * sensitivity.timing[block.part],
            np.full(len(block.t_s), noise.baseline_sigma[block.kind]),
        ]
        whitened, _ = whiten(block.t_s, np.column_stack([columns, *jitters]), noise.coloured[block.kind])
        # Each signal has its own zero in each run; power and time are common to all signals of the run.
        own = np.concatenate([places, count + np.array([0, 1, 2 + kinds.index(block.kind)])])
        gram[np.ix_(own, own)] += whitened.T @ whitened
    # The jitters have unit variance after their scaling: their prior is the identity, and they drop out in closed form.
    inner = gram[count:, count:] + np.eye(size)
    return np.asarray(gram[:count, :count] - gram[:count, count:] @ np.linalg.solve(inner, gram[count:, :count]))


def solve(gram: FloatArray, right: FloatArray) -> FloatArray:
    """Return gram⁻¹ right, restricted to the well-conditioned directions of gram."""
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    correlation = gram / scale / scale[:, None]
    values, vectors = np.linalg.eigh(correlation)
    # Of the correlations, not of the matrix: units would decide else which direction is well conditioned.
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
    # The ridge lets two parameters that do the same share the step, instead of a failed factorisation.
    correlation = gram[np.ix_(is_movable, is_movable)] / scale / scale[:, None] + (1e-9 + damping) * np.eye(len(scale))
    root = np.linalg.cholesky(correlation)
    target = np.linalg.solve(root, right[is_movable] / scale)
    scaled = np.linalg.solve(root.T, target)
    # The bounded problem takes far longer, and most steps are inside.
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


@dataclass(frozen=True)
class BaseParameterPrior:
    """Normal prior of the logarithms of the base parameters."""

    mean: tuple[float, ...]
    sigma: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class ModelFit:
    """Result of a fit.

    chi2: with priors; covariance: of base, then free parameters; gram: [k + 1, k + 1], the residual last
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


def compute_jitter_sensitivity(data: Dataset, point: ParameterPoint, prediction: FloatArray) -> JitterSensitivity:
    """Compute the sensitivities to power and timing by finite differences."""
    more_power = predict(data, point, power_factor=1.0 + POWER_STEP)
    later = predict(data, point, delay_s=DELAY_STEP_S)
    # Central, as a sample may lie at an edge, where both sides differ.
    earlier = predict(data, point, delay_s=-DELAY_STEP_S)
    return JitterSensitivity((more_power - prediction) / np.log1p(POWER_STEP), 0.5 * (later - earlier) / DELAY_STEP_S)


def apply_step(point: ParameterPoint, free: Sequence[FreeParameter], step: FloatArray) -> ParameterPoint:
    """Return the point after a step in base and free parameters, which `compute_step_limits` permits."""
    base = tuple(np.add(point.base, step[: len(BASE_PARAMETERS)]).tolist())
    terms: Mapping[str, Mapping[str, float]] = point.terms
    for item, change in zip(free, step[len(BASE_PARAMETERS) :].tolist(), strict=True):
        terms = item.with_value(terms, item.read_value(terms) + change)
    return ParameterPoint(base, terms)


def compute_step_limits(
    problem: FitProblem, point: ParameterPoint, free: Sequence[FreeParameter]
) -> tuple[FloatArray, FloatArray]:
    """Return the limits of one step in base and free parameters: their ranges, and the range of a linear model."""
    to_centre = np.subtract(problem.prior.mean, point.base)
    # A longer step leaves the range where the linear model holds.
    lower, upper = np.maximum(-0.5, to_centre - BASE_LOG_SPAN), np.minimum(0.5, to_centre + BASE_LOG_SPAN)
    for item in free:
        number, (low, high) = item.read_value(point.terms), item.limits
        max_change = 1.0 if item.logarithmic else 0.5 * (high - low)
        lower = np.append(lower, max(-max_change, low - number))
        upper = np.append(upper, min(max_change, high - number))
    # A point outside its range, as a start may be, is not forced inside.
    return np.minimum(lower, 0.0), np.maximum(upper, 0.0)


def compute_jacobian(
    problem: FitProblem, point: ParameterPoint, free: Sequence[FreeParameter], prediction: FloatArray
) -> FloatArray:
    """Compute derivatives [m, k] with respect to base and free parameters by finite differences."""
    columns = np.zeros((len(prediction), len(BASE_PARAMETERS) + len(free)))
    for names in MOVED_AS_ONE:
        blocks = {name: [each for each in problem.data.blocks if each.kind in ACTS_ON[name]] for name in names}
        if not any(blocks.values()):
            continue
        base = [
            number + BASE_LOG_STEP * (name in names) for name, number in zip(BASE_PARAMETERS, point.base, strict=True)
        ]
        difference = predict(problem.data, replace(point, base=tuple(base))) - prediction
        for name in names:
            for block in blocks[name]:
                columns[block.part, BASE_PARAMETERS.index(name)] = difference[block.part] / BASE_LOG_STEP
    for row, item in enumerate(free):
        number = item.read_value(point.terms)
        # At the upper limit of its range a number only moves down.
        for step in (item.step, -item.step):
            terms = item.with_value(point.terms, number + step)
            change = item.read_value(terms) - number
            if change != 0.0:
                break
        shifted = replace(point, terms=terms)
        columns[:, len(BASE_PARAMETERS) + row] = (predict(problem.data, shifted) - prediction) / change
    return columns


def fit(
    problem: FitProblem,
    point: ParameterPoint,
    free: Sequence[FreeParameter] = (),
    iterations: int = MAX_ITERATIONS,
    chi2_abandon: float = np.inf,
) -> ModelFit:
    """Minimise χ² from a point by Levenberg–Marquardt steps within the ranges of the parameters.

    A step to where the model diverges is shortened, as one that increases χ². Raises DivergedError if it does so at the
    start.

    chi2_abandon: from the second step on, the fit ends early if neither twice the predicted improvement nor as much as
    the last one brings χ² below this value.
    """
    data, count = problem.data, len(BASE_PARAMETERS) + len(free)
    prediction = predict(data, point)
    # Once, at the start: with sensitivities that moved along, χ² of two steps would not be comparable.
    sensitivity = compute_jitter_sensitivity(data, point, prediction)
    precision = np.concatenate([1.0 / np.square(problem.prior.sigma), np.zeros(len(free))])
    centre = np.concatenate([problem.prior.mean, np.zeros(len(free))])
    best: ModelFit | None = None
    step, trial = np.zeros(count), point
    damping, remaining = 0.0, iterations
    while best is None or remaining > 0:
        remaining -= 1
        deviation = np.concatenate([trial.base, np.zeros(len(free))]) - centre
        residual = (data.value - prediction)[:, None]
        cost = float(compute_normal_equations(data, residual, problem.noise, sensitivity)[0, 0])
        cost += float(precision @ deviation**2)
        if best is None and not np.isfinite(cost):
            raise DivergedError("the fit", Unquoted("a χ² that is no number"), "a finite one at its start")
        # Written so that a cost that is no number is refused, too.
        if best is not None and not cost <= best.chi2 - 1e-9:
            damping = max(DAMPING_INCREASE * damping, MIN_DAMPING)
            # So short a step changes no number that anyone reads.
            if float(np.abs(step).max()) < 1e-4:
                break
        else:
            improvement = np.inf if best is None else best.chi2 - cost
            damping = damping / DAMPING_DECREASE if damping > MIN_DAMPING else 0.0
            columns = np.column_stack([compute_jacobian(problem, trial, free, prediction), residual])
            gram = compute_normal_equations(data, columns, problem.noise, sensitivity)
            hessian = gram[:count, :count] + np.diag(precision)
            covariance = solve(hessian, np.eye(count))
            gradient = gram[:count, -1] - precision * deviation
            best = ModelFit(trial, tuple(free), cost, covariance, gram, prediction)
            limits = compute_step_limits(problem, trial, free)
            step = solve_within(hessian, gradient, *limits)
            predicted_improvement = float(2.0 * gradient @ step - step @ hessian @ step)
            if (
                predicted_improvement < CHI2_CONVERGED
                # A damped step is short by intention; its small gain says nothing about the minimum.
                or (improvement < CHI2_CONVERGED and not damping)
                or cost - max(2.0 * float(gradient @ covariance @ gradient), improvement) > chi2_abandon
            ):
                break
        step = solve_within(hessian, gradient, *limits, damping)
        trial = apply_step(best.point, free, step)
        try:
            prediction = predict(data, trial)
        except DivergedError:
            prediction = np.full_like(prediction, np.nan)  # its χ² is no number, and the step is refused
    return best
