"""Is there anything to explain, and where? Candidates by score, and an omnibus over bins, both against the noise model.

Every candidate is a column beside the base fit, at a finite size; its likelihood ratio follows from one matrix of all
columns. The level of the best of all candidates comes from draws of the same matrix (bounded numbers and time constants
that vanish with their effect have no textbook distribution). The noise model is an estimate itself, from as many
contrasts as runs repeat others: ratios are judged as F with so many degrees below, not as χ².
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi_squared
from scipy.stats import f as fisher

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, Dataset
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, compute_jacobian, compute_jitter_sensitivity
from optodrive.lab.diagnosis.hypotheses import Hypothesis
from optodrive.lab.diagnosis.normal_equations import compute_normal_equations, project_out, solve
from optodrive.lab.diagnosis.omnibus_test import compute_omnibus
from optodrive.lab.diagnosis.prediction import BASE_PARAMETERS, ParameterPoint, predict

DRAWS = 4000
NOISE_PRIOR_DEGREES, NOISE_KNOWN_DEGREES = 6, 10_000
"""What is known of a lab's noise beforehand counts as so many contrasts; degrees where there is nothing to learn."""


@dataclass(frozen=True)
class Score:
    """One start of a hypothesis beside the base fit: likelihood ratio, its degrees, amplitudes of its columns.

    seen: likelihood ratio that its start's size would give; own: share of its column that nothing else imitates
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
    """scores: the best start of every hypothesis, strongest first; p values of the best score and of the omnibus.

    omnibus, bins: its χ² and degrees; left: χ² of what the fit leaves
    """

    scores: tuple[Score, ...]
    p_score: float
    omnibus_chi2: float
    omnibus_degrees: int
    p_omnibus: float
    residual_chi2: float


def detect(
    problem: FitProblem,
    base: ModelFit,
    hypotheses: list[Hypothesis],
    seed: int,
    extra_columns: FloatArray | None = None,
) -> Detection:
    """Score every hypothesis beside a fit (nominal, or with terms already in it), and beside more columns [m, k]."""
    data = problem.data
    sensitivity = compute_jitter_sensitivity(data, base.point, problem.epsilon, base.prediction)
    known = compute_jacobian(problem, base.point, base.free, base.prediction)
    if extra_columns is not None:
        known = np.column_stack([known, extra_columns / np.abs(extra_columns).max(axis=0, initial=1e-300)])
    trials = [(item, start) for item in hypotheses for start in _select_starts(item)]
    terms = [{**base.point.terms, item.key: start} for item, start in trials]
    effects = [predict(data, ParameterPoint(base.point.base, own), problem.epsilon) - base.prediction for own in terms]
    candidates = np.stack(effects, axis=1) if effects else np.zeros((len(data.value), 0))
    scale = np.maximum(np.abs(candidates).max(axis=0, initial=0.0), 1e-30)
    residual = (data.value - base.prediction)[:, None]
    columns = np.column_stack([known, candidates / scale, residual])
    total = compute_normal_equations(data, columns, problem.noise, sensitivity.power, sensitivity.timing).total
    width = known.shape[1]
    total[range(len(BASE_PARAMETERS)), range(len(BASE_PARAMETERS))] += 1.0 / np.square(problem.prior.sigma)
    projected = project_out(total, list(range(width)), list(range(width, len(total))))
    independent = np.diag(projected) / np.maximum(np.diag(total)[width:], 1e-300)
    omnibus = compute_omnibus(problem, np.column_stack([known, residual]), sensitivity)
    scores, p_score = _compute_scores(trials, projected, scale, independent, seed, count_noise_degrees(data))
    residual_chi2 = float(projected[-1, -1])
    return Detection(tuple(scores), p_score, omnibus.chi2, omnibus.degrees, omnibus.p_value, residual_chi2)


def count_noise_degrees(data: Dataset) -> int:
    """Degrees of freedom of the noise model; a mirror's is held above what repeats show, and thus sure."""
    mirrors = all(kind in MIRROR_KINDS for kind in data.kinds)
    return NOISE_KNOWN_DEGREES if mirrors or not data.contrast_count else NOISE_PRIOR_DEGREES + data.contrast_count


def _select_starts(item: Hypothesis) -> tuple[dict[str, float], ...]:
    return item.starts[:1] if item.fit_every_start else item.starts


def _compute_scores(
    trials: list[tuple[Hypothesis, dict[str, float]]],
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
    for item, start, places in column_sets:
        ratio, amplitude = _compute_likelihood_ratio(gram, right, list(places), item.is_linear)
        last = places[-1]
        start_ratio = float(gram[last, last] * scale[last] ** 2)
        amplitudes = tuple((amplitude / scale[list(places)]).tolist())
        score = Score(item, start, ratio, amplitudes, places, start_ratio, float(independent[last]))
        if item.label not in best or ratio > best[item.label].ratio:
            best[item.label] = score
    observed = max(_compute_surprisal(score.ratio, len(score.columns), noise_degrees) for score in best.values())
    generator = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(gram)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = root @ generator.standard_normal((len(gram), DRAWS))
    max_surprisal = np.zeros(DRAWS)
    for item, _, places in column_sets:
        rows = list(places)
        solved = solve(gram[np.ix_(rows, rows)], draws[rows])
        ratio_drawn = (draws[rows] * solved).sum(axis=0)
        if not item.is_linear:
            ratio_drawn = np.where(solved[0] > 0.0, ratio_drawn, 0.0)
        max_surprisal = np.maximum(max_surprisal, -chi_squared.logsf(ratio_drawn, len(rows)))
    level = float(np.quantile(max_surprisal, 0.99))
    # Beyond the draws, the best of so many looks as if it were the best of e^(level) × 1 % independent ones.
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
    gram: FloatArray, right: FloatArray, places: list[int], either_sign: bool
) -> tuple[float, FloatArray]:
    inner = gram[np.ix_(places, places)]
    amplitude = solve(inner, right[places])
    if not either_sign and amplitude[0] <= 0.0:
        return 0.0, np.zeros(len(places))
    return float(right[places] @ amplitude), amplitude
