"""Selection of the causes: refits ranked by BIC, a verdict, a second cause where one is insufficient, and rivals.

Theory of operation

Problem. A recording differs from the model. Which term of the catalogue explains the difference, does one suffice, and
can another one do the same? The costly error is a wrong name: it makes somebody repair what is not broken.
"Unexplained" and "ambiguous" are answers, too.

Detection first. One family of tests asks whether anything is wrong at all: the best candidate's likelihood ratio and an
omnibus test of the residuals, at 0.1 % together (`FAMILY_ALPHA`), because the noise model is itself an estimate from a
few repeats. If repeats differ by more than the noise model allows, nothing is named.

Singles. The strongest candidates are refitted with all base parameters free (an effect that base parameters imitate is
none) and ranked by BIC. The best one is accepted if what remains is noise and it explains most of the excess.

Other forms before other causes. Real effects rarely have exactly their term's form: a droop that does not follow the
power leaves residuals, and a second, false cause would fit them. So the best single is given columns of its own effect
that grow or decay with power, heat, dose and time, or have another share in each signal (`discrepancy_basis.py`); if
they take the rest, the one cause is named. Only then are pairs tried, and a pair must gain more than those columns do,
by BIC. A pair may also show that the search began with the wrong single: it is then restarted from the pair's parts.

Thresholds are shares of the excess that a cause explains. They rise where a false name is easy: a second node behind
the absorber passes for a wall, another form for a second cause. They were set on recordings made for that purpose
(decisions 8 and 11).

Rivals. Candidates within `BIC_INDISTINGUISHABLE` of the chosen one make the verdict ambiguous, unless they merely
imitate it: more parameters, one of them at its bound, and a prediction that is equivalent.

Invariants. Nothing here changes the data or the noise model. The same recording and seed give the same verdict. A
hypothesis that cannot be computed is recorded in the log with its reason, and never counts as ruled out.
"""

from dataclasses import dataclass

import numpy as np

from optodrive.lab.diagnosis.detection import Detection, detect, score_effects, simulate_effects
from optodrive.lab.diagnosis.discrepancy_basis import compute_discrepancy_basis
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, compute_jitter_sensitivity
from optodrive.lab.diagnosis.normal_equations import compute_normal_equations
from optodrive.lab.diagnosis.refitting import (
    RefittedCandidate,
    refit_alone,
    refit_pairs,
    refit_strongest,
)
from optodrive.lab.diagnosis.search_log import SearchLog
from optodrive.physics.hypothesis import Hypothesis

FAMILY_ALPHA = 0.001
"""Significance level of the family of tests: keeps false alarms below 1 % although the noise model is an estimate."""
MAX_REPLICATE_EXCESS = 6.0
"""Maximum replicate excess, in σ, for runs of one group to count as repeats."""
MAX_INTRA_PULSE_POWER_EXCESS = 25.0
"""Maximum significance, in σ, of power changes within pulses."""
BIC_INDISTINGUISHABLE = 10.0
"""Rivals within this BIC difference of the best cannot be told apart: odds below about 150.

A larger value would keep rivals that imitate the best one with one more parameter, which costs ln samples.
"""
CHI2_EQUIVALENT = 9.0
"""Predictions that differ by less χ² than this are equivalent."""
MIN_EXPLAINED, MIN_EXPLAINED_BY_TERM = 0.9, 0.5
"""Share of the excess that a named cause explains; the share that suffices if its discrepancy basis takes the rest."""
MIN_EXPLAINED_BY_SHARES = 0.93
"""Share of the excess that a cause explains before its effect may have another share in each signal.

A second node behind the absorber would otherwise pass for a wall that the gas follows in part.
"""
MIN_EXPLAINED_OTHER_FORM = 0.985
"""A cause with significant residuals is still named if it explains this share of the excess."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """Verdict on a subsystem.

    chosen: the model for all later steps; candidates: best first; nominal_detection, residual_detection: beside the
    nominal fit and beside the chosen model; explained_fraction: share of the detected excess
    """

    verdict: str
    causes: tuple[str, ...]
    chosen: RefittedCandidate | None
    candidates: tuple[RefittedCandidate, ...]
    nominal_detection: Detection
    residual_detection: Detection | None
    explained_fraction: float


def is_rejected(detection: Detection) -> bool:
    """Return whether the better of the two tests, at half the level each, rejects the fit."""
    return min(detection.p_score, detection.p_omnibus) < 0.5 * FAMILY_ALPHA


def has_replicate_excess(problem: FitProblem) -> bool:
    """Return whether repeats differ by more than noise and jitters."""
    return (
        problem.noise.replicate_excess > MAX_REPLICATE_EXCESS
        or problem.noise.intra_pulse_power_excess > MAX_INTRA_PULSE_POWER_EXCESS
    )


def find_best_candidate(
    problem: FitProblem, base: ModelFit, hypotheses: list[Hypothesis], seed: int, log: SearchLog
) -> RefittedCandidate | None:
    """Return the best refit of the strongest hypotheses, or None if none is promising."""
    scores = detect(problem, base, hypotheses, seed, log).scores
    return next(iter(refit_strongest(problem, base, (), scores, log)), None)


def select_causes(
    problem: FitProblem, base: ModelFit, hypotheses: list[Hypothesis], seed: int, log: SearchLog
) -> Verdict:
    """Return the verdict on one subsystem."""
    log.on_progress("testing the nominal model")
    nominal_detection = detect(problem, base, hypotheses, seed, log)
    if has_replicate_excess(problem):
        return Verdict("unexplained", (), None, (), nominal_detection, None, 0.0)
    if not is_rejected(nominal_detection):
        return Verdict("none", (), None, (), nominal_detection, None, 0.0)
    singles = refit_strongest(problem, base, (), nominal_detection.scores, log)
    if not singles:
        return Verdict("unexplained", (), None, (), nominal_detection, None, 0.0)
    return select_from(problem, base, hypotheses, nominal_detection, singles, seed, log)


def select_from(
    problem: FitProblem,
    base: ModelFit,
    hypotheses: list[Hypothesis],
    nominal_detection: Detection,
    singles: list[RefittedCandidate],
    seed: int,
    log: SearchLog,
) -> Verdict:
    """Return the verdict that follows from refitted single causes, best first."""
    best = singles[0]
    log.on_progress(f"testing the residuals of {best.label}")
    others = [item for item in hypotheses if item.key not in best.causes]
    simulated = simulate_effects(problem, best.fit, others, log)
    residual_detection = score_effects(problem, best.fit, simulated, seed)
    single_explained = _compute_explained_fraction(residual_detection, base, best)
    if not is_rejected(residual_detection) and single_explained >= MIN_EXPLAINED:
        return _build_verdict(problem, singles, nominal_detection, residual_detection, single_explained)
    separate = single_explained >= MIN_EXPLAINED_BY_SHARES
    basis_columns = compute_discrepancy_basis(problem, best.fit, best.hypotheses, hypotheses, separate)
    basis_detection = score_effects(problem, best.fit, simulated, seed, basis_columns)
    if (
        not is_rejected(basis_detection)
        and single_explained >= MIN_EXPLAINED_BY_TERM
        and max(single_explained, _compute_explained_fraction(basis_detection, base, best)) >= MIN_EXPLAINED
    ):
        return _build_verdict(problem, singles, nominal_detection, residual_detection, single_explained)
    form_gain = (
        residual_detection.residual_chi2
        - basis_detection.residual_chi2
        - basis_columns.shape[1] * np.log(len(problem.data.value))
    )
    candidates = refit_pairs(problem, base, hypotheses, singles, residual_detection, seed, log)
    pairs = [item for item in candidates if _is_pair_needed(item, singles, form_gain)]
    if pairs:
        restarted = refit_alone(problem, base, pairs[0], singles, log)
        if singles[0].bic - restarted[0].bic > BIC_INDISTINGUISHABLE:
            return select_from(problem, base, hypotheses, nominal_detection, restarted, seed, log)
        pair = pairs[0]
        log.on_progress(f"testing the residuals of {pair.label}")
        others = [item for item in hypotheses if item.key not in pair.causes]
        simulated = simulate_effects(problem, pair.fit, others, log)
        pair_detection = score_effects(problem, pair.fit, simulated, seed)
        pair_explained = _compute_explained_fraction(pair_detection, base, pair)
        # A second cause may only correct the first one's form; it is named if the residuals are insignificant.
        if not is_rejected(pair_detection) or (pair_explained >= MIN_EXPLAINED_OTHER_FORM > single_explained):
            return _build_verdict(problem, pairs, nominal_detection, pair_detection, pair_explained)
        if pair_explained >= MIN_EXPLAINED and not is_rejected(
            score_effects(
                problem,
                pair.fit,
                simulated,
                seed,
                compute_discrepancy_basis(
                    problem, pair.fit, pair.hypotheses, hypotheses, pair_explained >= MIN_EXPLAINED_BY_SHARES
                ),
            )
        ):
            return _build_verdict(problem, pairs, nominal_detection, pair_detection, pair_explained)
    # If only one cause can occur, no other can be confused with it.
    min_explained = MIN_EXPLAINED_OTHER_FORM if len({item.key for item in hypotheses}) > 1 else MIN_EXPLAINED
    if (
        single_explained >= MIN_EXPLAINED
        and max(single_explained, _compute_explained_fraction(basis_detection, base, best)) >= min_explained
    ):
        return _build_verdict(problem, singles, nominal_detection, residual_detection, single_explained)
    return Verdict("unexplained", (), None, (*pairs, *singles), nominal_detection, residual_detection, single_explained)


def _compute_excess(detection: Detection) -> float:
    return max(0.0, detection.omnibus_chi2 - detection.omnibus_degrees)


def _compute_explained_fraction(residual_detection: Detection, base: ModelFit, best: RefittedCandidate) -> float:
    """Return the share of the excess that a candidate explains: its decrease of χ², relative to that plus the rest."""
    reduction = base.chi2 - best.fit.chi2
    score = residual_detection.scores[0].ratio if residual_detection.scores else 0.0
    remaining = max(
        0.0, _compute_excess(residual_detection) - 2.5 * np.sqrt(2.0 * residual_detection.omnibus_degrees), score - 12.0
    )
    return float(reduction / max(reduction + remaining, 1e-9))


def _is_pair_needed(pair: RefittedCandidate, singles: list[RefittedCandidate], form_gain: float) -> bool:
    """Return whether a pair beats the best single cause by more than the rivals' margin and its discrepancy basis.

    form_gain: decrease of χ² by the basis of the best single cause, minus its BIC penalty
    """
    return singles[0].bic - pair.bic > BIC_INDISTINGUISHABLE + max(0.0, form_gain)


def _is_imitation(problem: FitProblem, rival: RefittedCandidate, best: RefittedCandidate) -> bool:
    """Return whether a rival with more parameters, one of them at a limit, predicts the same as the best candidate."""
    terms = rival.fit.point.terms
    if len(rival.fit.free) <= len(best.fit.free) or not any(
        not item.parameter.low < terms[item.key][item.names[0]] < item.parameter.high for item in rival.fit.free
    ):
        return False
    sensitivity = compute_jitter_sensitivity(problem.data, best.fit.point, problem.epsilon, best.fit.prediction)
    difference = (rival.fit.prediction - best.fit.prediction)[:, None]
    return (
        float(
            compute_normal_equations(
                problem.data, difference, problem.noise, sensitivity.power, sensitivity.timing
            ).total[0, 0]
        )
        < CHI2_EQUIVALENT
    )


def _build_verdict(
    problem: FitProblem,
    ranked: list[RefittedCandidate],
    nominal_detection: Detection,
    residual_detection: Detection,
    explained_fraction: float,
) -> Verdict:
    best = ranked[0]
    rivals = [
        item
        for item in ranked
        if item.bic - best.bic < BIC_INDISTINGUISHABLE and not _is_imitation(problem, item, best)
    ]
    keys = list(dict.fromkeys(key for item in rivals for key in item.causes))
    if len({frozenset(item.causes) for item in rivals}) > 1:
        return Verdict(
            "ambiguous", tuple(keys), best, tuple(ranked), nominal_detection, residual_detection, explained_fraction
        )
    if not problem.noise.from_replicates:
        return Verdict(
            "ambiguous",
            tuple(best.causes),
            best,
            tuple(ranked),
            nominal_detection,
            residual_detection,
            explained_fraction,
        )
    return Verdict("cause", best.causes, best, tuple(ranked), nominal_detection, residual_detection, explained_fraction)
