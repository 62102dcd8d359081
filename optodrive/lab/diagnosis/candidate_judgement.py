"""Judgement of every hypothesis, and the numbers of those that were refitted."""

from math import exp

import numpy as np

from optodrive.core.quantity import format_quantity
from optodrive.core.types.discrepancy import CandidateCause, RivalModel
from optodrive.lab.diagnosis.detection import Score
from optodrive.lab.diagnosis.model_selection import Selection
from optodrive.physics.terms import discover_terms

DETECTABLE_RATIO = 30.0
"""Likelihood ratio of an effect that is detected nine times in ten."""
MAX_RULED_OUT = 1e-4
"""Probability up to which a cause is ruled out."""
NOISE_CHI2 = 6.0
"""Difference of χ² to the best fit that noise alone gives, or of twice the log evidence: no cause so near is ruled out,
however improbable."""
MIN_INDEPENDENT_FRACTION = 1e-4
"""Minimum share of an effect that is orthogonal to the base parameters for the effect to be observable."""


def judge_candidates(selection: Selection, gains: dict[str, float]) -> tuple[CandidateCause, ...]:
    """Return the judgement of every hypothesis.

    gains: reduction on held-out runs by label
    """
    chosen = selection.chosen
    near = _list_near(selection)
    out = []
    for score in selection.nominal_detection.scores:
        item = score.hypothesis
        probability = selection.probabilities.sum_of(item.key)
        if chosen is not None and item.label in {part.label for part in chosen.hypotheses}:
            judgement = "identified" if selection.claim.verdict == "cause" else "indistinguishable"
        elif item.key in selection.claim.causes:
            judgement = "indistinguishable" if selection.claim.verdict == "ambiguous" else "alternative form"
        # Before "possible": what the base parameters imitate is not seen in any recording like this one.
        elif score.independent_fraction < MIN_INDEPENDENT_FRACTION:
            judgement = "not observable"
        # A prior alone rules nothing out: a candidate whose χ² the noise does not separate stays possible.
        elif probability > MAX_RULED_OUT or item.label in near:
            judgement = "possible"
        else:
            # A small score excludes nothing but a large effect; "ruled out" needs an effect that would have been seen.
            judgement = "not detected" if score.ratio < DETECTABLE_RATIO else "ruled out"
        out.append(
            CandidateCause(
                item.key,
                item.label,
                score.ratio,
                probability,
                gains.get(item.label),
                judgement,
                _describe_detection_limit(score),
            )
        )
    return tuple(out)


def _list_near(selection: Selection) -> set[str]:
    """Return the labels of the hypotheses near the winner, by χ² of their refit or score, or by their probability.

    A prior or an Occam's factor makes a hypothesis of such a χ² improbable, but the data do not exclude it. The winner
    was refitted; it may itself be improbable beside hypotheses that count by their score.
    """
    nominal, stated = selection.nominal_chi2, selection.probabilities
    winner, min_probability = nominal, stated.no_effect
    if selection.claim.verdict != "none" and selection.ranked:
        best = selection.ranked[0]
        winner, min_probability = best.chi2, stated.causes[tuple(sorted({part.key for part in best.hypotheses}))]
    min_probability *= exp(-0.5 * NOISE_CHI2)
    refits: dict[str, float] = {}
    for item in selection.ranked:
        for part in item.hypotheses:
            refits[part.label] = min(refits.get(part.label, item.chi2), item.chi2)
    scores = {score.hypothesis.label: nominal - score.ratio for score in selection.nominal_detection.scores}
    near = {label for label, chi2 in (scores | refits).items() if chi2 <= winner + NOISE_CHI2}
    hypotheses = (score.hypothesis for score in selection.nominal_detection.scores)
    return near | {item.label for item in hypotheses if stated.sum_of(item.key) >= min_probability}


def _describe_detection_limit(score: Score) -> str:
    """Return the smallest detectable size as text."""
    stated_limit = discover_terms()[score.hypothesis.key].detection_limit
    if stated_limit:
        return stated_limit
    # The start ratio is that of the last column of a score.
    free = score.hypothesis.free[-1 if score.hypothesis.is_linear else 0]
    start = score.start.get(free.names[0], 0.0) or 1.0
    if score.start_ratio <= 0.0 or score.independent_fraction < MIN_INDEPENDENT_FRACTION:
        return "not observable"
    size = abs(start) * float(np.sqrt(DETECTABLE_RATIO / score.start_ratio))
    if size > 3.0 * free.parameter.high:
        return f"more than {format_quantity(free.parameter.high, free.parameter.unit)}"
    return f"{'all' if len(free.names) > 1 else free.names[0]} {format_quantity(size, free.parameter.unit, 2)}"


def list_rivals(selection: Selection, gains: dict[str, float]) -> tuple[RivalModel, ...]:
    """Return the refitted candidates, best first.

    gains: reduction on held-out runs by label
    """
    candidates = selection.ranked
    if not candidates:
        return ()
    chi2 = min(item.chi2 for item in candidates)
    evidence = max(item.log_evidence for item in candidates)
    probabilities = selection.probabilities.causes
    return tuple(
        RivalModel(
            item.label,
            item.causes,
            item.chi2 - chi2,
            item.log_evidence - evidence,
            probabilities.get(tuple(sorted(item.causes)), 0.0),
            gains.get(item.label),
            item is selection.chosen,
            {
                f"{free.key}.{name}": (item.fit.point.terms[free.key][name], free.parameter.unit)
                for free in item.fit.free
                for name in free.names
            },
        )
        for item in candidates
    )
