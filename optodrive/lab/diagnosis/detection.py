"""Detection of model errors: a score per hypothesis and an omnibus test over bins, both under the noise model.

Each start of a hypothesis is a column beside the base fit, at a finite size; its likelihood ratio follows from one
matrix of all columns. The log notes what cannot be computed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.linalg import LinAlgError

from optodrive.core.errors import DivergedError, OptodriveError
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.diagnosis.evidence import compute_form_evidence
from optodrive.lab.diagnosis.fitting import (
    FitProblem,
    ModelFit,
    compute_jacobian,
    compute_jitter_sensitivity,
    compute_normal_equations,
    project_out,
    solve,
)
from optodrive.lab.diagnosis.omnibus_test import OmnibusStatistic, compute_omnibus
from optodrive.lab.diagnosis.prediction import (
    BASE_PARAMETERS,
    ParameterPoint,
    join_samples,
    predict,
    record,
    simulate_records,
)
from optodrive.lab.diagnosis.replicate_contrasts import JitterSensitivity
from optodrive.physics.hypothesis import Hypothesis
from optodrive.physics.terms import discover_terms

T = TypeVar("T")
UNCOMPUTABLE = (DivergedError, LinAlgError, FloatingPointError, ZeroDivisionError)
"""Errors of a hypothesis that cannot be computed."""

ProgressCallback = Callable[[str], None]


def ignore_progress(stage: str) -> None:
    """Report no progress."""


@dataclass(frozen=True)
class SearchLog:
    """Log of a search.

    failures: why a hypothesis could not be computed, by its label; omissions: why a step was left out that the verdict
    does not need, by its name
    """

    on_progress: ProgressCallback = ignore_progress
    failures: dict[str, str] = field(default_factory=dict)
    omissions: dict[str, str] = field(default_factory=dict)

    def add_failure(self, label: str, error: Exception) -> None:
        """Note that a hypothesis could not be computed. Its first error is kept."""
        self.failures.setdefault(label, str(error))

    def attempt(self, step: str, function: Callable[..., T], default: T, *arguments: Any) -> T:
        """Return the result of a step that the verdict does not need, or the default and a note if it fails."""
        try:
            return function(*arguments)
        except Exception as error:
            self.omissions.setdefault(step, f"{type(error).__name__}: {error}".splitlines()[0])
            return default


ROUNDING_FRACTION = 1e-12
"""An effect with a smaller share orthogonal to the fitted parameters is known only by rounding errors, and unseen."""


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
    """Scores of all hypotheses, strongest first, and the omnibus test, both beside a fit.

    residual_chi2: χ² of the residuals of the fit; form_evidence: gain in log evidence by other forms of its cause
    """

    scores: tuple[Score, ...]
    omnibus: OmnibusStatistic
    residual_chi2: float
    form_evidence: float = 0.0


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
    # Jitters act along the derivatives of this fit, for all candidates alike: their scores are comparable, refits have
    # their own.
    sensitivity = compute_jitter_sensitivity(problem.data, base.point, base.prediction)
    fitted_columns = compute_jacobian(problem, base.point, base.free, base.prediction)
    starts: list[tuple[Hypothesis, dict[str, float]]] = []
    effects: list[FloatArray] = []
    records = simulate_records(problem.data, base.point)
    for item in hypotheses:
        if item.label in log.failures:
            continue
        try:
            # A finite size: at size zero a time constant or a shape has no derivative.
            changes = [_simulate_start(problem, base, records, item.key, start) for start in _select_starts(item)]
        except UNCOMPUTABLE as error:
            log.add_failure(item.label, error)
            continue
        starts += [(item, start) for start in _select_starts(item)]
        effects += changes
    stacked = np.stack(effects, axis=1) if effects else np.zeros((len(problem.data.value), 0))
    return SimulatedEffects(tuple(starts), stacked, fitted_columns, sensitivity)


def _simulate_start(
    problem: FitProblem, base: ModelFit, records: list[FloatArray], key: str, start: dict[str, float]
) -> FloatArray:
    """Return the change of the prediction [m] by a term beside a fit without it.

    records: what the instruments record under the fit
    """
    term = discover_terms()[key]
    if term.only_records and key not in base.point.terms:  # acts on what the other terms leave, which is known
        signals = join_samples(problem.data, record(problem.data, term, start, records))
    else:
        signals = predict(problem.data, ParameterPoint(base.point.base, {**base.point.terms, key: start}))
    return signals - base.prediction


def detect(
    problem: FitProblem, base: ModelFit, hypotheses: list[Hypothesis], log: SearchLog | None = None
) -> Detection:
    """Score every hypothesis beside a fit, nominal or extended."""
    return score_effects(problem, base, simulate_effects(problem, base, hypotheses, log or SearchLog()))


def score_effects(
    problem: FitProblem, base: ModelFit, simulated: SimulatedEffects, forms: FloatArray | None = None
) -> Detection:
    """Score the effects beside the fit that they were computed for.

    forms: [m, k], other forms of its cause, are marginalised too
    """
    data, sensitivity = problem.data, simulated.sensitivity
    fitted_columns, candidates = simulated.fitted_columns, simulated.effects
    form_count = 0 if forms is None else forms.shape[1]
    if forms is not None:
        fitted_columns = np.column_stack([fitted_columns, forms])
    # Effects differ by orders of magnitude, and the Gram matrix squares that.
    scale = np.maximum(np.abs(candidates).max(axis=0, initial=0.0), 1e-30)
    residual = (data.value - base.prediction)[:, None]
    columns = np.column_stack([fitted_columns, candidates / scale, residual])
    total = compute_normal_equations(data, columns, problem.noise, sensitivity)
    width = fitted_columns.shape[1]
    # The base parameters have a prior: an effect that they imitate only far from it counts as an effect.
    total[range(len(BASE_PARAMETERS)), range(len(BASE_PARAMETERS))] += 1.0 / np.square(problem.prior.sigma)
    form_evidence = 0.0
    if form_count:
        parameters = list(range(width - form_count))
        # The forms' own evidence is beside the fitted parameters alone, before any candidate.
        beside = project_out(total, parameters, [*range(width - form_count, width), len(total) - 1])
        form_evidence = compute_form_evidence(beside[:-1, :-1], beside[:-1, -1])
    projected = project_out(total, list(range(width)), list(range(width, len(total))))
    independent = np.diag(projected) / np.maximum(np.diag(total)[width:], 1e-300)
    omnibus = compute_omnibus(problem, np.column_stack([fitted_columns, residual]), sensitivity)
    scores = compute_scores(simulated.starts, projected, scale, independent)
    residual_chi2 = float(projected[-1, -1])
    numbers = [omnibus.chi2, omnibus.evidence.log_evidence, residual_chi2, *(score.ratio for score in scores)]
    if np.isnan(numbers).any() or not np.isfinite(numbers[:3]).all():  # no comparison with a number would be true
        raise OptodriveError("the test of the residuals gave no number; nothing is concluded from it")
    return Detection(tuple(scores), omnibus, residual_chi2, form_evidence)


def _select_starts(item: Hypothesis) -> tuple[dict[str, float], ...]:
    # Each start of such a hypothesis needs a fit of its own, so one stands for all here.
    return item.starts[:1] if item.fit_every_start else item.starts


def compute_scores(
    trials: tuple[tuple[Hypothesis, dict[str, float]], ...],
    projected: FloatArray,
    scale: FloatArray,
    independent: FloatArray,
) -> list[Score]:
    """Return the best start of each hypothesis, strongest first.

    projected: gram matrix of the columns and the residual; independent: share of each column's that is left
    """
    column_sets: list[tuple[Hypothesis, dict[str, float], tuple[int, ...]]] = []
    joint: dict[str, list[int]] = {}
    for column, (item, start) in enumerate(trials):
        # Sizes that act together are scored together, each at its own amplitude.
        if item.is_linear and item.degrees > 1:
            joint.setdefault(item.label, []).append(column)
            if len(joint[item.label]) == len(item.starts):
                column_sets.append((item, item.starts[0], tuple(joint[item.label])))
        else:
            column_sets.append((item, start, (column,)))
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
        if item.label not in best or not ratio <= best[item.label].ratio:
            best[item.label] = score
    return sorted(best.values(), key=lambda score: -score.ratio)


def _compute_likelihood_ratio(
    gram: FloatArray, right: FloatArray, indices: list[int], either_sign: bool
) -> tuple[float, FloatArray]:
    inner = gram[np.ix_(indices, indices)]
    amplitude = solve(inner, right[indices])
    # A size that cannot be negative gains nothing where the data want it negative.
    if not either_sign and amplitude[0] <= 0.0:
        return 0.0, np.zeros(len(indices))
    return float(right[indices] @ amplitude), amplitude
