"""Refits of the hypotheses that a detection found strongest, alone and in pairs, ranked by their evidence."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from optodrive.lab.diagnosis.detection import UNCOMPUTABLE, Detection, Score, SearchLog, detect
from optodrive.lab.diagnosis.evidence import compute_log_evidence
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, compute_normal_equations, fit
from optodrive.lab.diagnosis.prediction import ParameterPoint, predict
from optodrive.lab.diagnosis.replicate_contrasts import JitterSensitivity
from optodrive.physics.hypothesis import FreeParameter, Hypothesis
from optodrive.physics.terms import discover_terms

CHI2_ABANDON = 300.0
"""A fit that is predicted to stay this far above the best χ² is abandoned."""
CHI2_UNCONVERGED, UNCONVERGED_SHARE = 1.0, 0.02
"""A fit that ends so far above the χ² of its score, or by so much less of it, may have ended in another minimum."""
MIN_RATIO = 6.0
"""Likelihood ratio from which a hypothesis is refitted."""
MAX_REFITS = 9
"""Number of the strongest hypotheses that are refitted."""
MAX_STARTS, MAX_RESTARTS, MAX_RETRIES = 6, 6, 3
"""Number of starts refitted of a hypothesis with many, of restarts of each, and of other starts of a failed fit."""
AMPLITUDES = (0.2, 5.0)
"""Factors on a number with a logarithm within which its effect is proportional to it."""
MAX_SECOND_CAUSES, MAX_FIRST_CAUSES = 4, 2
"""Number of second causes refitted beside each of the best first causes, and number of those."""


@dataclass(frozen=True, eq=False)
class RefittedCandidate:
    """One or two hypotheses, refitted.

    fit: under the jitters at its end; log_evidence: of its χ²
    """

    hypotheses: tuple[Hypothesis, ...]
    fit: ModelFit
    log_evidence: float

    @property
    def chi2(self) -> float:
        """χ² of the fit."""
        return self.fit.chi2

    @property
    def causes(self) -> tuple[str, ...]:
        """Keys of the causes."""
        return tuple(item.key for item in self.hypotheses)

    @property
    def label(self) -> str:
        """Labels of the hypotheses, joined."""
        return " and ".join(item.label for item in self.hypotheses)


def refit_strongest(
    problem: FitProblem,
    base: ModelFit,
    given: tuple[Hypothesis, ...],
    detection: Detection,
    log: SearchLog,
    count: int = MAX_REFITS,
) -> list[RefittedCandidate]:
    """Refit the strongest scores beside a fit in full, best first."""
    scores, fits = detection.scores[:count], list[tuple[Score, ModelFit]]()
    chi2_abandon = np.inf
    for score in scores:
        # Scores are sorted, so all others are weaker too.
        if score.ratio <= max(MIN_RATIO, 0.05 * scores[0].ratio):
            break
        log.on_progress(f"fitting {score.hypothesis.label}")
        free = (*base.free, *score.hypothesis.free)
        try:
            if score.hypothesis.fit_every_start:
                result = _refit_every_start(problem, base, score.hypothesis, free)
            else:
                result = fit(problem, _build_start(base.point, score), free, chi2_abandon=chi2_abandon)
        except UNCOMPUTABLE as error:
            log.add_failure(score.hypothesis.label, error)
            continue
        # By its score this hypothesis reaches a lower χ²: a fit that ends above it has missed its minimum.
        tolerance = max(CHI2_UNCONVERGED, UNCONVERGED_SHARE * score.ratio)
        has_missed = _is_within_ranges(score) and result.chi2 > detection.residual_chi2 - score.ratio + tolerance
        # The effect of a filter is not proportional to its width, so its score says little about the best start.
        if has_missed or (discover_terms()[score.hypothesis.key].only_records and not score.hypothesis.is_linear):
            result = _retry(problem, base, score.hypothesis, free, result)
        # The abandoned ones too: they count by the χ² at which they were left.
        fits.append((score, result))
        chi2_abandon = min(chi2_abandon, result.chi2 + CHI2_ABANDON)
    candidates = []
    for score, result in fits:
        # After all fits, when the limit is known: settling costs as much as the fit.
        settled = _settle(problem, result) if result.chi2 < chi2_abandon else result
        hypotheses = (*given, score.hypothesis)
        candidates.append(RefittedCandidate(hypotheses, settled, compute_log_evidence(problem, settled)))
    return sorted(candidates, key=lambda item: -item.log_evidence)


def _settle(problem: FitProblem, result: ModelFit) -> ModelFit:
    """Return a fit begun again at its end until χ² stays: jitters act along the sensitivities at the start of a fit."""
    for _ in range(MAX_RESTARTS):
        again = fit(problem, result.point, result.free)
        if abs(again.chi2 - result.chi2) < CHI2_UNCONVERGED:
            return again
        result = again
    return result


def _retry(
    problem: FitProblem, base: ModelFit, hypothesis: Hypothesis, free: Sequence[FreeParameter], result: ModelFit
) -> ModelFit:
    """Return the best fit from the nearest starts of the hypothesis, each abandoned where it stays above the best."""
    if hypothesis.fit_every_start:
        return result
    # Only a better χ² replaces the result, so a retry never makes a fit worse.
    for point in _select_nearest_starts(problem, base, hypothesis)[:MAX_RETRIES]:
        with suppress(*UNCOMPUTABLE):
            result = min(result, fit(problem, point, free, chi2_abandon=result.chi2), key=lambda item: item.chi2)
    return result


def _is_within_ranges(score: Score) -> bool:
    """Return whether the amplitudes of a score, at which it has its likelihood ratio, are within their ranges."""
    item = score.hypothesis
    sizes = item.free if item.is_linear else item.free[:1]
    starts = item.starts if len(score.amplitude) > 1 else (score.start,)
    return all(
        free.parameter.low <= amplitude * start[free.names[0]] <= free.parameter.high
        and (not free.logarithmic or AMPLITUDES[0] <= amplitude <= AMPLITUDES[1])
        for free, amplitude, start in zip(sizes, score.amplitude, starts, strict=True)
    )


def refit_pairs(
    problem: FitProblem,
    hypotheses: list[Hypothesis],
    singles: list[RefittedCandidate],
    residual_detection: Detection,
    log: SearchLog,
) -> list[RefittedCandidate]:
    """Refit second causes beside each of the best first causes. Return the best pairs first."""
    candidates: list[RefittedCandidate] = []
    for row, first in enumerate(singles[:MAX_FIRST_CAUSES]):
        others = [item for item in hypotheses if item.key not in first.causes]
        # The best single was examined already.
        detection = residual_detection if row == 0 else detect(problem, first.fit, others, log)
        candidates += refit_strongest(problem, first.fit, first.hypotheses, detection, log, MAX_SECOND_CAUSES)
    unique: dict[frozenset[str], RefittedCandidate] = {}
    for item in sorted(candidates, key=lambda candidate: -candidate.log_evidence):
        unique.setdefault(frozenset(part.label for part in item.hypotheses), item)
    return list(unique.values())


def refit_alone(
    problem: FitProblem,
    base: ModelFit,
    pair: RefittedCandidate,
    singles: list[RefittedCandidate],
    log: SearchLog,
) -> list[RefittedCandidate]:
    """Return the single causes, best first, with those of a pair refitted from where the pair ended.

    A fit alone may have ended in another minimum; the pair would then be named for what one of its causes explains.
    """
    best = {item.label: item for item in singles}
    chi2_abandon = min(item.chi2 for item in singles) + CHI2_ABANDON
    for item in pair.hypotheses:
        log.on_progress(f"fitting {item.label} again")
        # The base parameters of the pair too: beside them its cause lies in the right minimum.
        point = ParameterPoint(pair.fit.point.base, {**base.point.terms, item.key: pair.fit.point.terms[item.key]})
        free = (*base.free, *item.free)
        try:
            result = fit(problem, point, free, chi2_abandon=chi2_abandon)
            result = _settle(problem, result) if result.chi2 < chi2_abandon else result
        except UNCOMPUTABLE as error:
            log.add_failure(item.label, error)
            continue
        candidate = RefittedCandidate((item,), result, compute_log_evidence(problem, result))
        best[item.label] = max(best.get(item.label, candidate), candidate, key=lambda each: each.log_evidence)
    return sorted(best.values(), key=lambda each: -each.log_evidence)


def _build_start(point: ParameterPoint, score: Score) -> ParameterPoint:
    """Return the point of a score's start at the amplitude found, within its ranges."""
    item = score.hypothesis
    terms = {**point.terms, item.key: dict(score.start)}
    if item.is_linear and item.degrees > 1:
        values = dict.fromkeys(score.start, 0.0)
        for free, amplitude, start in zip(item.free, score.amplitude, item.starts, strict=True):
            number = amplitude * start[free.names[0]]
            values[free.names[0]] = min(max(number, free.parameter.low), free.parameter.high)
        return ParameterPoint(point.base, {**point.terms, item.key: values})
    free = item.free[0]
    # Beyond these factors an effect is not proportional to such a number, and the start would leave its valley.
    scale = score.amplitude[0] if not free.logarithmic else float(np.clip(score.amplitude[0], *AMPLITUDES))
    value = score.start[free.names[0]] * scale
    return ParameterPoint(point.base, free.with_value(terms, float(np.log(value)) if free.logarithmic else value))


def _refit_every_start(
    problem: FitProblem, base: ModelFit, item: Hypothesis, free: Sequence[FreeParameter]
) -> ModelFit:
    """Return the best fit from the nearest starts, each begun again at its end until χ² is stationary."""
    # Jitter acts along the derivatives at the start of a fit: along wrong ones a servo's delay passes for a lower
    # bandwidth.
    fits = (_settle(problem, fit(problem, point, free)) for point in _select_nearest_starts(problem, base, item))
    return min(fits, key=lambda item: item.chi2)


def _select_nearest_starts(problem: FitProblem, base: ModelFit, item: Hypothesis) -> list[ParameterPoint]:
    """Return the starts with the smallest χ² without a fit."""
    zero = np.zeros(len(problem.data.value))
    none = JitterSensitivity(zero, zero)

    def cost(point: ParameterPoint) -> float:
        residual = problem.data.value - predict(problem.data, point)
        # Without jitters: their sensitivities cost three predictions for each of many starts, which only need an order.
        return float(compute_normal_equations(problem.data, residual[:, None], problem.noise, none)[0, 0])

    points = (ParameterPoint(base.point.base, {**base.point.terms, item.key: values}) for values in item.starts)
    return sorted(points, key=cost)[:MAX_STARTS]
