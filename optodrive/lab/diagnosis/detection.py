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
from optodrive.lab.diagnosis.fitting import Fit, Problem, jitter, slopes
from optodrive.lab.diagnosis.hypotheses import Hypothesis
from optodrive.lab.diagnosis.normal_equations import normal, projected, solve
from optodrive.lab.diagnosis.omnibus_test import binned
from optodrive.lab.diagnosis.prediction import BASE, Point, predict

DRAWS = 4000
PRIOR, SURE = 6, 10_000
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
    seen: float
    own: float


@dataclass(frozen=True, eq=False)
class Detection:
    """scores: the best start of every hypothesis, strongest first; p values of the best score and of the omnibus.

    omnibus, bins: its χ² and degrees; left: χ² of what the fit leaves
    """

    scores: tuple[Score, ...]
    p_score: float
    omnibus: float
    bins: int
    p_omnibus: float
    left: float


def detect(
    problem: Problem, base: Fit, found: list[Hypothesis], seed: int, beside: FloatArray | None = None
) -> Detection:
    """Score every hypothesis beside a fit (nominal, or with terms already in it), and beside more columns [m, k]."""
    data = problem.data
    shared = jitter(data, base.point, problem.epsilon, base.prediction)
    known = slopes(problem, base.point, base.free, base.prediction)
    if beside is not None:
        known = np.column_stack([known, beside / np.abs(beside).max(axis=0, initial=1e-300)])
    trials = [(item, start) for item in found for start in _tried(item)]
    terms = [{**base.point.terms, item.key: start} for item, start in trials]
    extra = [predict(data, Point(base.point.base, own), problem.epsilon) - base.prediction for own in terms]
    candidates = np.stack(extra, axis=1) if extra else np.zeros((len(data.value), 0))
    scale = np.maximum(np.abs(candidates).max(axis=0, initial=0.0), 1e-30)
    residual = (data.value - base.prediction)[:, None]
    columns = np.column_stack([known, candidates / scale, residual])
    total = normal(data, columns, problem.noise, shared.power, shared.timing).total()
    width = known.shape[1]
    total[range(len(BASE)), range(len(BASE))] += 1.0 / np.square(problem.prior.sigma)
    left = projected(total, list(range(width)), list(range(width, len(total))))
    own = np.diag(left) / np.maximum(np.diag(total)[width:], 1e-300)
    found_bins = binned(problem, np.column_stack([known, residual]), shared)
    scores, p_score = _scores(trials, left, scale, own, seed, sureness(data))
    rest = float(left[-1, -1])
    return Detection(tuple(scores), p_score, found_bins.chi2, found_bins.degrees, found_bins.p_value(), rest)


def sureness(data: Dataset) -> int:
    """Degrees of freedom of the noise model; a mirror's is held above what repeats show, and thus sure."""
    mirrors = all(kind in MIRROR_KINDS for kind in data.kinds())
    return SURE if mirrors or not data.contrasts() else PRIOR + data.contrasts()


def _tried(item: Hypothesis) -> tuple[dict[str, float], ...]:
    return item.starts[:1] if item.every else item.starts


def _scores(
    trials: list[tuple[Hypothesis, dict[str, float]]],
    left: FloatArray,
    scale: FloatArray,
    own: FloatArray,
    seed: int,
    contrasts: int,
) -> tuple[list[Score], float]:
    sets: list[tuple[Hypothesis, dict[str, float], tuple[int, ...]]] = []
    joint: dict[str, list[int]] = {}
    for column, (item, start) in enumerate(trials):
        if item.linear and item.degrees > 1:
            joint.setdefault(item.label, []).append(column)
            if len(joint[item.label]) == len(item.starts):
                sets.append((item, item.starts[0], tuple(joint[item.label])))
        else:
            sets.append((item, start, (column,)))
    if not sets:
        return [], 1.0
    gram, right = left[:-1, :-1], left[:-1, -1]
    best: dict[str, Score] = {}
    for item, start, places in sets:
        ratio, amplitude = _ratio(gram, right, list(places), item.linear)
        last = places[-1]
        seen = float(gram[last, last] * scale[last] ** 2)
        amplitudes = tuple((amplitude / scale[list(places)]).tolist())
        score = Score(item, start, ratio, amplitudes, places, seen, float(own[last]))
        if item.label not in best or ratio > best[item.label].ratio:
            best[item.label] = score
    observed = max(_surprise(score.ratio, len(score.columns), contrasts) for score in best.values())
    generator = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(gram)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = root @ generator.standard_normal((len(gram), DRAWS))
    least = np.zeros(DRAWS)
    for item, _, places in sets:
        rows = list(places)
        solved = solve(gram[np.ix_(rows, rows)], draws[rows])
        ratio_drawn = (draws[rows] * solved).sum(axis=0)
        if not item.linear:
            ratio_drawn = np.where(solved[0] > 0.0, ratio_drawn, 0.0)
        least = np.maximum(least, -chi_squared.logsf(ratio_drawn, len(rows)))
    level = float(np.quantile(least, 0.99))
    # Beyond the draws, the best of so many looks as if it were the best of e^(level) × 1 % independent ones.
    drawn = float((least >= observed).mean())
    p = (
        max(drawn, 1.0 / DRAWS)
        if observed < level
        else min(drawn if drawn > 0 else 1.0, 0.01 * np.exp(level - observed))
    )
    return sorted(best.values(), key=lambda score: -score.ratio), float(p)


def _surprise(ratio: float, degrees: int, contrasts: int) -> float:
    return float(-fisher.logsf(ratio / degrees, degrees, contrasts))


def _ratio(gram: FloatArray, right: FloatArray, places: list[int], either_sign: bool) -> tuple[float, FloatArray]:
    inner = gram[np.ix_(places, places)]
    amplitude = solve(inner, right[places])
    if not either_sign and amplitude[0] <= 0.0:
        return 0.0, np.zeros(len(places))
    return float(right[places] @ amplitude), amplitude
