"""Detection of model errors: a score per hypothesis and an omnibus test over bins, both under the noise model.

Each start of a hypothesis is a column beside the base fit, at a finite size; its likelihood ratio follows from one
matrix of all columns. The distribution of the best score is simulated with the same matrix, because bounded parameters
and time constants that vanish with their effect have no textbook distribution. The noise model is an estimate from a
finite number of contrasts, so ratios are judged by an F distribution with that many denominator degrees, not by χ².
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi_squared
from scipy.stats import f as fisher

from optodrive.core.errors import DivergedError, OptodriveError
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, Dataset
from optodrive.lab.diagnosis.fitting import (
    FitProblem,
    JitterSensitivity,
    ModelFit,
    compute_jacobian,
    compute_jitter_sensitivity,
)
from optodrive.lab.diagnosis.normal_equations import compute_normal_equations, project_out, solve
from optodrive.lab.diagnosis.omnibus_test import compute_omnibus
from optodrive.lab.diagnosis.prediction import BASE_PARAMETERS, ParameterPoint, predict
from optodrive.lab.diagnosis.search_log import SearchLog
from optodrive.physics.hypothesis import Hypothesis

DRAWS = 4000
ROUNDING_FRACTION = 1e-12
"""An effect with a smaller share orthogonal to the fitted parameters is known only by rounding errors, and unseen."""
NOISE_PRIOR_DEGREES, NOISE_KNOWN_DEGREES = 6, 10_000
"""Degrees of freedom of the prior knowledge of noise; degrees of freedom where the noise model counts as known."""


@dataclass(frozen=True)
class Score:
    """Best start of a hypothesis beside a fit: likelihood ratio and amplitudes of its columns.

    start_ratio: likelihood ratio at the size of the start; independent_fraction: share of the column that is orthogonal
    to all fitted parameters
    """

    hypothesis: Hypothesis
    start: dict[str, float]
    ratio: float
    amplitude: tuple[float, ...]
    columns: tuple[int, ...]
    start_ratio: float
    independent_fraction: float


@dataclass(frozen=True, eq=False)
class Detection:
    """Scores of all hypotheses, strongest first, with the p values of the best score and of the omnibus test.

    residual_chi2: χ² of the residuals of the fit
    """

    scores: tuple[Score, ...]
    p_score: float
    omnibus_chi2: float
    omnibus_degrees: int
    p_omnibus: float
    residual_chi2: float


@dataclass(frozen=True, eq=False)
class SimulatedEffects:
    """The columns of a detection beside one fit.

    starts: each start of each hypothesis; effects: [m, starts] change of the prediction; fitted_columns: [m, k] of the
    fitted parameters
    """

    starts: tuple[tuple[Hypothesis, dict[str, float]], ...]
    effects: FloatArray
    fitted_columns: FloatArray
    sensitivity: JitterSensitivity


def simulate_effects(
    problem: FitProblem, base: ModelFit, hypotheses: list[Hypothesis], log: SearchLog
) -> SimulatedEffects:
    """Simulate every start of every hypothesis beside a fit, nominal or extended.

    A hypothesis of which one start diverges is left out, here and later, and noted in the log.
    """
    sensitivity = compute_jitter_sensitivity(problem.data, base.point, problem.epsilon, base.prediction)
    fitted_columns = compute_jacobian(problem, base.point, base.free, base.prediction)
    starts: list[tuple[Hypothesis, dict[str, float]]] = []
    effects: list[FloatArray] = []
    for item in hypotheses:
        if item.label in log.failures:
            continue
        points = [
            ParameterPoint(base.point.base, {**base.point.terms, item.key: start}) for start in _select_starts(item)
        ]
        try:
            changes = [predict(problem.data, point, problem.epsilon) - base.prediction for point in points]
        except DivergedError as error:
            log.add_failure(item.label, error)
            continue
        starts += [(item, start) for start in _select_starts(item)]
        effects += changes
    stacked = np.stack(effects, axis=1) if effects else np.zeros((len(problem.data.value), 0))
    return SimulatedEffects(tuple(starts), stacked, fitted_columns, sensitivity)


def detect(
    problem: FitProblem, base: ModelFit, hypotheses: list[Hypothesis], seed: int, log: SearchLog | None = None
) -> Detection:
    """Score every hypothesis beside a fit, nominal or extended."""
    return score_effects(problem, base, simulate_effects(problem, base, hypotheses, log or SearchLog()), seed)


def score_effects(
    problem: FitProblem, base: ModelFit, simulated: SimulatedEffects, seed: int, extra_columns: FloatArray | None = None
) -> Detection:
    """Score the effects beside the fit that they were computed for.

    extra_columns: [m, k], are marginalised too
    """
    data, sensitivity = problem.data, simulated.sensitivity
    fitted_columns, candidates = simulated.fitted_columns, simulated.effects
    if extra_columns is not None:
        fitted_columns = np.column_stack(
            [fitted_columns, extra_columns / np.abs(extra_columns).max(axis=0, initial=1e-300)]
        )
    scale = np.maximum(np.abs(candidates).max(axis=0, initial=0.0), 1e-30)
    residual = (data.value - base.prediction)[:, None]
    columns = np.column_stack([fitted_columns, candidates / scale, residual])
    total = compute_normal_equations(data, columns, problem.noise, sensitivity.power, sensitivity.timing).total
    width = fitted_columns.shape[1]
    total[range(len(BASE_PARAMETERS)), range(len(BASE_PARAMETERS))] += 1.0 / np.square(problem.prior.sigma)
    projected = project_out(total, list(range(width)), list(range(width, len(total))))
    independent = np.diag(projected) / np.maximum(np.diag(total)[width:], 1e-300)
    omnibus = compute_omnibus(problem, np.column_stack([fitted_columns, residual]), sensitivity)
    scores, p_score = _compute_scores(simulated.starts, projected, scale, independent, seed, count_noise_degrees(data))
    residual_chi2 = float(projected[-1, -1])
    if not np.isfinite([p_score, omnibus.p_value, residual_chi2]).all():  # no comparison with a level would reject it
        raise OptodriveError("the test of the residuals gave no number; nothing is concluded from it")
    return Detection(tuple(scores), p_score, omnibus.chi2, omnibus.degrees, omnibus.p_value, residual_chi2)


def count_noise_degrees(data: Dataset) -> int:
    """Return the degrees of freedom of the noise model.

    Mirror noise, raised above its estimate, counts as known.
    """
    mirrors = all(kind in MIRROR_KINDS for kind in data.kinds)
    return NOISE_KNOWN_DEGREES if mirrors or not data.contrast_count else NOISE_PRIOR_DEGREES + data.contrast_count


def _select_starts(item: Hypothesis) -> tuple[dict[str, float], ...]:
    return item.starts[:1] if item.fit_every_start else item.starts


def _compute_scores(
    trials: tuple[tuple[Hypothesis, dict[str, float]], ...],
    projected: FloatArray,
    scale: FloatArray,
    independent: FloatArray,
    seed: int,
    noise_degrees: int,
) -> tuple[list[Score], float]:
    column_sets: list[tuple[Hypothesis, dict[str, float], tuple[int, ...]]] = []
    joint: dict[str, list[int]] = {}
    for column, (item, start) in enumerate(trials):
        if item.is_linear and item.degrees > 1:
            joint.setdefault(item.label, []).append(column)
            if len(joint[item.label]) == len(item.starts):
                column_sets.append((item, item.starts[0], tuple(joint[item.label])))
        else:
            column_sets.append((item, start, (column,)))
    if not column_sets:
        return [], 1.0
    gram, right = projected[:-1, :-1], projected[:-1, -1]
    best: dict[str, Score] = {}
    for item, start, indices in column_sets:
        ratio, amplitude = 0.0, np.zeros(len(indices))
        if independent[list(indices)].min() > ROUNDING_FRACTION:
            ratio, amplitude = _compute_likelihood_ratio(gram, right, list(indices), item.is_linear)
        last = indices[-1]
        start_ratio = float(gram[last, last] * scale[last] ** 2)
        amplitudes = tuple((amplitude / scale[list(indices)]).tolist())
        score = Score(item, start, ratio, amplitudes, indices, start_ratio, float(independent[last]))
        if item.label not in best or ratio > best[item.label].ratio:
            best[item.label] = score
    surprisals = [_compute_surprisal(score.ratio, len(score.columns), noise_degrees) for score in best.values()]
    observed = float(np.max(surprisals))  # no number if one is none
    generator = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(gram)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = root @ generator.standard_normal((len(gram), DRAWS))
    max_ratio: dict[int, FloatArray] = {}
    for item, _, indices in column_sets:
        rows = list(indices)
        if independent[rows].min() <= ROUNDING_FRACTION:
            continue
        solved = solve(gram[np.ix_(rows, rows)], draws[rows])
        ratio_drawn = (draws[rows] * solved).sum(axis=0)
        if not item.is_linear:
            ratio_drawn = np.where(solved[0] > 0.0, ratio_drawn, 0.0)
        max_ratio[len(rows)] = np.maximum(max_ratio.get(len(rows), 0.0), ratio_drawn)
    max_surprisal = np.zeros(DRAWS)
    for degrees, ratio_drawn in max_ratio.items():  # once per number of degrees, because it takes long
        max_surprisal = np.maximum(max_surprisal, -chi_squared.logsf(ratio_drawn, degrees))
    if not np.isfinite(max_surprisal).all() or np.isnan(observed):  # an infinite one rejects: its p underflows to zero
        return [], np.nan
    level = float(np.quantile(max_surprisal, 0.99))
    # Beyond the draws, extrapolate as for the maximum of 1 % × e^level independent scores.
    exceedance = float((max_surprisal >= observed).mean())
    p = (
        max(exceedance, 1.0 / DRAWS)
        if observed < level
        else min(exceedance if exceedance > 0 else 1.0, 0.01 * np.exp(level - observed))
    )
    return sorted(best.values(), key=lambda score: -score.ratio), float(p)


def _compute_surprisal(ratio: float, degrees: int, noise_degrees: int) -> float:
    return float(-fisher.logsf(ratio / degrees, degrees, noise_degrees))


def _compute_likelihood_ratio(
    gram: FloatArray, right: FloatArray, indices: list[int], either_sign: bool
) -> tuple[float, FloatArray]:
    inner = gram[np.ix_(indices, indices)]
    amplitude = solve(inner, right[indices])
    if not either_sign and amplitude[0] <= 0.0:
        return 0.0, np.zeros(len(indices))
    return float(right[indices] @ amplitude), amplitude
