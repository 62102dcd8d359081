"""Selection of the causes: refits of the strongest hypotheses, alone and in pairs, and the verdict by probabilities.

Theory of operation

Problem. A recording differs from the model. Which term of the catalogue explains the difference, does one suffice, and
can another one do the same? The costly error is a wrong name: it makes somebody repair what is not broken.
"Unexplained" and "ambiguous" are answers, too.

Explanations. Every hypothesis is scored beside the nominal fit. The strongest are refitted with all base parameters
free (an effect that base parameters imitate is none); the others count by their score. The best ones are also given
other forms of their own effect and a free mean per bin, and second causes are refitted beside them. A pair may show
that a search began with the wrong single, whose parts are then refitted alone. `evidence.py` turns all of them into
probabilities.

Verdict. What may be claimed of these numbers is decided in `lab/inference/claim.py`.

Invariants. Nothing here changes the data or the noise model. The same recording gives the same verdict. A hypothesis
that cannot be computed is recorded in the log with its reason.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import log, log1p, prod

import numpy as np

from optodrive.core.types.discrepancy import Probabilities
from optodrive.lab.diagnosis.detection import Detection, SearchLog, detect, score_effects, simulate_effects
from optodrive.lab.diagnosis.estimates import compute_discrepancy_basis
from optodrive.lab.diagnosis.evidence import (
    FORM_REST,
    MAX_FORM_PROBABILITY,
    OTHER_ODDS,
    PAIR_REST,
    PRIOR_NO_EFFECT,
    PRIOR_NONE_OF_THESE,
    PRIOR_ONE_CAUSE,
    PRIOR_TWO_CAUSES,
    Explanation,
    NoiseCertainty,
    compute_hidden_share,
    compute_log_evidence,
    compute_own_share,
    compute_probabilities,
    compute_score_evidence,
    count_noise_degrees,
)
from optodrive.lab.diagnosis.fitting import FitProblem, ModelFit, fit
from optodrive.lab.diagnosis.prediction import predict
from optodrive.lab.diagnosis.refitting import RefittedCandidate, refit_alone, refit_pairs, refit_strongest
from optodrive.lab.inference.claim import MIN_EXPLAINED, UNJUDGED, Alternative, Claim, Evidence, HeldOutChange, claim
from optodrive.physics.hypothesis import Hypothesis
from optodrive.physics.terms import discover_terms

NEAR_CHI2 = 30.0
"""χ² above the best refit within which another one is always examined."""
EXAMINED_SINGLES, EXAMINED_PAIRS = 3, 2
"""Number of the best refits that are examined for other forms and for what they leave."""
RESTART_GAIN = 1.0
"""Gain in log evidence of a refit from where a pair ended that begins the search again."""
PAIR_SCORE = 12.0
"""Likelihood ratio of a second cause from which pairs are refitted."""
NO_EFFECT_SHARE = 1e-5
"""Share of a signal's range below which a change is an error of the integration, whose steps terms may refine."""
CERTAIN = 0.995
"""Probability of none of these where repeats differ by more than noise."""
MAX_REPLICATE_EXCESS = 6.0
"""Maximum replicate excess, in σ, for runs of one group to count as repeats."""
MAX_INTRA_PULSE_POWER_EXCESS = 25.0
"""Maximum significance, in σ, of power changes within pulses."""


@dataclass(frozen=True, eq=False)
class Selection:
    """The explanations of a subsystem, compared.

    candidates: refits, most probable first; evidence: with an alternative for each of these; nominal_detection: beside
    the nominal fit; nominal_chi2: of that fit; claim: the judge's
    """

    candidates: tuple[RefittedCandidate, ...]
    evidence: Evidence
    nominal_detection: Detection
    nominal_chi2: float
    claim: Claim = UNJUDGED

    def judge(
        self,
        held_out: Mapping[RefittedCandidate, tuple[HeldOutChange, ...]],
        doubts: Mapping[RefittedCandidate, Mapping[str, str]],
    ) -> "Selection":
        """Return the selection with its claim, where held-out runs and doubts about sizes are known."""
        alternatives = tuple(
            replace(alternative, held_out=held_out.get(item, ()), doubts=doubts.get(item, {}))
            for item, alternative in zip(self.candidates, self.evidence.alternatives, strict=True)
        )
        evidence = replace(self.evidence, alternatives=alternatives)
        return replace(self, evidence=evidence, claim=claim(evidence))

    @property
    def probabilities(self) -> Probabilities:
        """Probabilities of all explanations."""
        return self.evidence.probabilities

    @property
    def chosen(self) -> RefittedCandidate | None:
        """The model for all later steps: that of the first set that the claim names, None without one."""
        named = {tuple(sorted(keys)) for keys in self.claim.sets[:1]}
        return next((item for item in self.candidates if tuple(sorted(item.causes)) in named), None)

    @property
    def ranked(self) -> tuple[RefittedCandidate, ...]:
        """Refits, the chosen one first, then by probability."""
        chosen = self.chosen
        return tuple(sorted(self.candidates, key=lambda item: item is not chosen))

    @property
    def explained_fraction(self) -> float:
        """Share of the detected excess that the chosen model explains."""
        chosen = self.chosen
        if chosen is None:
            return 0.0
        explained = self.evidence.alternatives[self.candidates.index(chosen)].explained
        return 0.0 if explained is None else explained[0]


@dataclass(frozen=True, eq=False)
class _Examination:
    """Residual tests of a refit, without and with other forms of its cause.

    log_evidence: of the refit as it ended; explained, explained_with_forms: shares of the excess
    """

    detection: Detection
    with_forms: Detection
    log_evidence: float
    explained: float
    explained_with_forms: float


_Examined = dict[RefittedCandidate, _Examination]


def has_replicate_excess(problem: FitProblem) -> bool:
    """Return whether repeats differ by more than noise and jitters."""
    return (
        problem.noise.replicate_excess > MAX_REPLICATE_EXCESS
        or problem.noise.intra_pulse_power_excess > MAX_INTRA_PULSE_POWER_EXCESS
    )


def compare_explanations(
    problem: FitProblem, base: ModelFit, hypotheses: list[Hypothesis], log: SearchLog
) -> Selection:
    """Compare all explanations of one subsystem."""
    log.on_progress("testing the nominal model")
    nominal_detection = detect(problem, base, hypotheses, log)
    # Repeats that differ so, as by missed pulses, leave no noise by which explanations could be compared.
    if has_replicate_excess(problem):
        probabilities = Probabilities(1.0 - CERTAIN, CERTAIN, {(item.key,): 0.0 for item in hypotheses})
        return Selection((), Evidence(probabilities, (), repeats_differ=True), nominal_detection, base.chi2)
    singles = refit_strongest(problem, base, (), nominal_detection, log)
    return compare_from_single_causes(problem, base, hypotheses, nominal_detection, singles, log)


def compare_from_single_causes(
    problem: FitProblem,
    base: ModelFit,
    hypotheses: list[Hypothesis],
    nominal_detection: Detection,
    singles: list[RefittedCandidate],
    log: SearchLog,
    examined: "_Examined | None" = None,
) -> Selection:
    """Compare the explanations that follow from refitted single causes, best first.

    examined: what is known already of some of them
    """
    examined = {} if examined is None else examined
    pairs: list[RefittedCandidate] = []
    # The forms of a cause cost many predictions, so only the best refits get them.
    for item in select_near(base, singles)[:EXAMINED_SINGLES]:
        _examine(problem, base, hypotheses, item, examined, log)
    if singles:
        residual_detection = examined[singles[0]].detection
        # Pairs cost the most; without a second effect in what the best single leaves, none is fitted.
        if residual_detection.scores and residual_detection.scores[0].ratio > PAIR_SCORE:
            pairs = refit_pairs(problem, hypotheses, select_near(base, singles), residual_detection, log)
            # A single that ended in a side minimum leaves a rest, for which a pair would be named falsely.
            restarted = refit_alone(problem, base, pairs[0], singles, log) if pairs else singles
            if restarted[0].log_evidence > singles[0].log_evidence + RESTART_GAIN:
                return compare_from_single_causes(
                    problem, base, hypotheses, nominal_detection, restarted, log, examined
                )
        for item in select_near(base, pairs)[:EXAMINED_PAIRS]:
            _examine(problem, base, hypotheses, item, examined, log)
    explanations = _list_explanations(problem, base, hypotheses, nominal_detection, [*singles, *pairs], examined, log)
    probabilities = compute_probabilities(explanations)
    best: dict[tuple[str, ...], RefittedCandidate] = {}
    for item in sorted([*singles, *pairs], key=lambda candidate: -candidate.log_evidence):
        # Several hypotheses of one cause share its probability; its best fit stands for them in numbers.
        best.setdefault(tuple(sorted(item.causes)), item)
    candidates = tuple(best[keys] for keys, _ in probabilities.ranked if keys in best)
    shares = {item: (rest.explained, rest.explained_with_forms) for item, rest in examined.items()}
    alternatives = tuple(Alternative(item.causes, shares.get(item)) for item in candidates)
    twins = _pair_twins(nominal_detection)
    evidence = Evidence(probabilities, alternatives, twins, problem.noise.from_replicates)
    return Selection(candidates, evidence, nominal_detection, base.chi2)


def _pair_twins(detection: Detection) -> dict[str, str]:
    """Return the twins of the causes by these, both ways.

    A twin explains at least half of what the other one does.
    """
    ratios: dict[str, float] = {}
    acting = set()
    for score in detection.scores:
        key = score.hypothesis.key
        ratios[key] = max(ratios.get(key, 0.0), score.ratio)
        # A twin in the gas shows in displacement and force; the same instrument term in the thermometer alone is none.
        if {"displacement", "force"}.intersection(score.hypothesis.free[0].names):
            acting.add(key)
    pairs = [(key, twin) for key in acting if (twin := discover_terms()[key].twin) in ratios]
    both_ways = [each for pair in pairs for each in (pair, pair[::-1])]
    # Where another signal is measured as well, it tells the twins apart.
    return {first: second for first, second in both_ways if ratios[second] >= MIN_EXPLAINED * ratios[first]}


def select_near(base: ModelFit, ranked: list[RefittedCandidate]) -> list[RefittedCandidate]:
    """Return the refits that leave so little more than the best one that other forms of their effect may explain it."""
    if not ranked:
        return []
    best = min(item.chi2 for item in ranked)
    # A large effect leaves much in a slightly different form, so what counts as near grows with the effect.
    limit = best + max(NEAR_CHI2, FORM_REST * (base.chi2 - best))
    return [item for item in ranked if item.chi2 < limit or item is ranked[0]]


def _examine(
    problem: FitProblem,
    base: ModelFit,
    hypotheses: list[Hypothesis],
    item: RefittedCandidate,
    examined: _Examined,
    log: SearchLog,
) -> None:
    """Add the residual tests of a refit to those known."""
    if item in examined:
        return
    log.on_progress(f"testing the residuals of {item.label}")
    # Its own cause is not among the rivals of a refit: another hypothesis of it is one of its forms.
    simulated = simulate_effects(
        problem, item.fit, [other for other in hypotheses if other.key not in item.causes], log
    )
    forms = compute_discrepancy_basis(problem, item.fit, item.hypotheses, hypotheses)
    detections = score_effects(problem, item.fit, simulated), score_effects(problem, item.fit, simulated, forms)
    # The tests are of the fit as it is: one that ended early may count by its score, and must not gain its rest twice.
    chi2 = max(item.chi2, detections[0].residual_chi2)
    log_evidence, reduction = item.log_evidence - 0.5 * (chi2 - item.chi2), base.chi2 - chi2
    plain, with_forms = (_compute_explained_fraction(detection, reduction) for detection in detections)
    examined[item] = _Examination(*detections, log_evidence, plain, max(plain, with_forms))


def _compute_explained_fraction(detection: Detection, reduction: float) -> float:
    """Return the share of the excess that a candidate explains: its decrease of χ², relative to that plus the rest."""
    score = detection.scores[0].ratio if detection.scores else 0.0
    degrees = detection.omnibus.degrees
    # 2.5 σ in the bins and a best score of 12 count as noise; only what exceeds them is a rest.
    remaining = max(0.0, detection.omnibus.chi2 - degrees - 2.5 * np.sqrt(2.0 * degrees), score - 12.0)
    return float(reduction / max(reduction + remaining, 1e-9))


def _list_explanations(
    problem: FitProblem,
    base: ModelFit,
    hypotheses: list[Hypothesis],
    nominal_detection: Detection,
    refits: list[RefittedCandidate],
    examined: _Examined,
    search_log: SearchLog,
) -> list[Explanation]:
    """Return every explanation of the recording with its prior and its evidence."""
    degrees_of = _count_degrees(problem, base, refits)
    degrees = degrees_of.pop(None)
    nothing = compute_log_evidence(problem, base)
    something = nothing + nominal_detection.omnibus.evidence.log_evidence
    out = [
        Explanation((), log(PRIOR_NO_EFFECT), nothing, degrees),
        # None of these: the same nominal model, with free means in the bins.
        Explanation((), log(PRIOR_NONE_OF_THESE), something, degrees, own_share=0.0),
    ]
    priors = _Priors(hypotheses)
    refitted = {item.label for item in refits}
    for score in nominal_detection.scores:
        if score.hypothesis.label not in refitted:
            # By its score, so that a weak candidate costs no fit and still takes its share of the probability.
            evidence = nothing + compute_score_evidence(score.ratio)
            prior, hidden = priors.compute((score.hypothesis,)), compute_hidden_share(score.ratio)
            out.append(Explanation((score.hypothesis.key,), prior, evidence, degrees, hidden=hidden))
    for item in refits:
        prior = priors.compute(item.hypotheses)
        # A pair's effect is hidden only if both together are.
        hidden = compute_hidden_share(base.chi2 - item.chi2)
        out.append(Explanation(item.causes, prior, item.log_evidence, degrees_of[item], hidden=hidden))
        single, share = _find_sufficient_single(item, refits, examined)
        # Signals in which the first cause does not act show the second one by itself, which then mends nothing.
        if single is not None and _is_seen_beside(problem, base, single, item, search_log):
            single, share = None, 0.0
        if single is not None:
            # The pair's fit, counted for its first cause: the second one was one of the catalogue by chance.
            mended = priors.compute(single.hypotheses) + log(OTHER_ODDS * share / priors.catalogue)
            out.append(Explanation(single.causes, mended, item.log_evidence, degrees_of[item]))
        if item not in examined:
            continue
        for more_odds, evidence, own in _list_variants(examined[item], base.chi2 - item.chi2):
            out.append(Explanation(item.causes, prior + more_odds + log1p(-share), evidence, degrees, own))
            if single is not None:
                out.append(Explanation(single.causes, prior + more_odds + log(share), evidence, degrees, own))
    return out


class _Priors:
    """Prior probabilities of causes: shared among the catalogue, and those of one cause among its hypotheses."""

    def __init__(self, hypotheses: list[Hypothesis]) -> None:
        # The prior of a cause must not rise because a recording cannot show the others.
        self.catalogue = len(discover_terms())  # also of a subsystem that few of them act in
        self._forms = Counter(item.key for item in hypotheses)

    def compute(self, hypotheses: Sequence[Hypothesis]) -> float:
        """Return the logarithm of the prior of one hypothesis, or of two together."""
        pairs = self.catalogue * (self.catalogue - 1) // 2
        prior = PRIOR_ONE_CAUSE / self.catalogue if len(hypotheses) == 1 else PRIOR_TWO_CAUSES / pairs
        return log(prior / prod(self._forms[item.key] * count_trials(item) for item in hypotheses))


def _list_variants(rest: _Examination, reduction: float) -> list[tuple[float, float, float]]:
    """Return log odds, log evidence and own share of a refit with other forms, with free bins, and with both.

    reduction: of χ² by the refit
    """
    odds, forms = log(OTHER_ODDS), rest.log_evidence + rest.with_forms.form_evidence
    own = compute_own_share(1.0 - rest.explained, FORM_REST)
    bins, both = rest.detection.omnibus.evidence, rest.with_forms.omnibus.evidence
    return [
        (odds, forms, own),
        (odds, rest.log_evidence + bins.log_evidence, bins.compute_own_share(reduction)),
        (2.0 * odds, forms + both.log_evidence, own * both.compute_own_share(reduction)),
    ]


def _count_degrees(
    problem: FitProblem, base: ModelFit, refits: list[RefittedCandidate]
) -> dict[RefittedCandidate | None, float]:
    """Return the degrees of freedom of the noise between the best refit and each, and the nominal fit (None)."""
    if not refits:
        return {None: count_noise_degrees(problem.data)}
    # Differences to the best are what probabilities are made of, so the noise must be known there.
    best = max(refits, key=lambda item: item.log_evidence)
    certainty = NoiseCertainty(problem, best.fit)
    return {None: certainty.count_degrees(base)} | {item: certainty.count_degrees(item.fit) for item in refits}


def count_trials(hypothesis: Hypothesis) -> int:
    """Return the number of forms of an effect of which the best one is taken, with no number for it in the fit."""
    return len(hypothesis.starts) if hypothesis.is_linear and hypothesis.degrees == 1 else 1


def _find_sufficient_single(
    item: RefittedCandidate, refits: list[RefittedCandidate], examined: _Examined
) -> tuple[RefittedCandidate | None, float]:
    """Return the cause of a pair that may explain all in another form, and the probability that it does.

    Its second cause may only mend the form of the first one, as any cause of the catalogue may do by chance; a pair
    that leaves a rest is not literally true at all.
    """
    singles = [
        (other, compute_own_share(1.0 - examined[other].explained_with_forms, PAIR_REST))
        for other in refits
        if len(item.causes) == 2 and len(other.causes) == 1 and other.causes[0] in item.causes and other in examined
    ]
    best, share = max(singles, key=lambda pair: pair[1], default=(None, 0.0))
    return (best, min(share, MAX_FORM_PROBABILITY)) if share > 0.0 else (None, 0.0)


def _is_seen_beside(
    problem: FitProblem, base: ModelFit, single: RefittedCandidate, pair: RefittedCandidate, search_log: SearchLog
) -> bool:
    """Return whether the second cause of a pair mends no form of the first one.

    A cause that has no other form needs no mending. Any other acts on its own signals alone: a second cause that the
    rest of them show by themselves, beside the nominal model, is a cause.
    """
    (first,) = single.hypotheses
    if discover_terms()[first.key].is_exact:
        return True
    data, point = problem.data, single.fit.point
    others = {key: values for key, values in point.terms.items() if key != first.key}
    effect = single.fit.prediction - predict(data, replace(point, terms=others))
    acting = {
        block.kind
        for block in data.blocks
        # Exact equality fails: a term may change the integration's steps in signals that it does not act on.
        if not np.allclose(effect[block.part], 0.0, atol=NO_EFFECT_SHARE * float(np.ptp(data.value[block.part])))
    }
    kinds = tuple(kind for kind in data.kinds if kind not in acting)
    if not kinds:
        return False
    part = replace(
        problem, data=data.select(sorted({block.run for block in data.blocks if block.kind in kinds}), kinds)
    )
    second = [item for item in pair.hypotheses if item.key != first.key]
    scores = detect(part, fit(part, base.point, base.free), second, search_log).scores
    return bool(scores) and scores[0].ratio > PAIR_SCORE
