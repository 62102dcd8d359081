"""Probabilities of explanations: they sum to one, and no rival within the noise of the winner is ruled out."""

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.core.types.discrepancy import Probabilities
from optodrive.lab.diagnosis import candidate_judgement
from optodrive.lab.diagnosis.candidate_judgement import NOISE_CHI2, judge_candidates
from optodrive.lab.diagnosis.detection import Detection, Score
from optodrive.lab.diagnosis.evidence import KNOWN_DEGREES, Explanation, compute_probabilities, compute_score_evidence
from optodrive.lab.diagnosis.model_selection import Selection
from optodrive.lab.inference.claim import Claim, Evidence
from optodrive.physics.hypothesis import Hypothesis
from optodrive.physics.terms import discover_terms

KEYS = sorted(discover_terms())
evidences = st.lists(st.floats(-50.0, 1e6), min_size=2, max_size=len(KEYS))
ROUNDING = 1e-6
"""Of a difference of χ² of 1e5: a rival at the very limit may be on either side of it."""
degrees = st.sampled_from([8, 20, KNOWN_DEGREES])


def explain(values, none_of_these, noise_degrees):
    """Return the probabilities of causes with these log evidences, beside no effect and something else."""
    some = [Explanation((key,), -4.0, value, noise_degrees) for key, value in zip(KEYS, values, strict=False)]
    others = [
        Explanation((), -0.7, 0.0, noise_degrees),
        Explanation((), -2.3, none_of_these, noise_degrees, own_share=0.0),
    ]
    return compute_probabilities([*some, *others])


@given(evidences, st.floats(-50.0, 1e6), degrees)
def test_probabilities_sum_to_one(values, none_of_these, noise_degrees):
    found = explain(values, none_of_these, noise_degrees)
    every = [found.no_effect, found.none_of_these, *found.causes.values()]
    assert all(0.0 <= item <= 1.0 for item in every)
    assert sum(every) == pytest.approx(1.0)
    both = found.combine(Probabilities(0.5, 0.2, {("mirror_lag",): 0.3}))
    assert both.no_effect + both.none_of_these + sum(both.causes.values()) == pytest.approx(1.0)


def judge(chi2, occam, refitted, noise_degrees, nominal_chi2=1e5):
    """Return the judgement of each cause, and their probabilities.

    chi2: of each cause's fit; occam: what its log evidence loses by its parameters; refitted: the others count by score
    """
    found = explain([0.5 * (nominal_chi2 - a) - b for a, b in zip(chi2, occam, strict=True)], 0.0, noise_degrees)
    hypotheses = {key: Hypothesis(key, key, ({},), ()) for key in KEYS[: len(chi2)]}
    fits = dict(zip(hypotheses, chi2, strict=True))
    scores = tuple(
        Score(item, {}, nominal_chi2 - fits[key], (1.0,), (0,), 1.0, 1.0) for key, item in hypotheses.items()
    )
    ranked = [keys[0] for keys, _ in found.ranked if refitted[KEYS.index(keys[0])]]
    refits = tuple(SimpleNamespace(causes=(key,), hypotheses=(hypotheses[key],), chi2=fits[key]) for key in ranked)
    detection = Detection(scores, SimpleNamespace(), 0.0)
    selection = Selection(refits, Evidence(found, ()), detection, nominal_chi2, Claim("ambiguous"))
    return {item.cause: item.verdict for item in judge_candidates(selection, {})}, found


@pytest.fixture(autouse=True)
def without_limits(monkeypatch):
    monkeypatch.setattr(candidate_judgement, "_describe_detection_limit", lambda score: "")


@st.composite
def fitted_candidates(draw):
    """Draw χ², Occam's factor and whether it is refitted, of some causes: many of them near the best one."""
    count = draw(st.integers(2, len(KEYS)))
    best = draw(st.floats(0.0, 9e4))
    chi2 = [best + draw(st.sampled_from([0.0, 2.0, 6.0, 9.0, 50.0, 1e4])) for _ in range(count)]
    occam = draw(st.lists(st.floats(0.0, 40.0), min_size=count, max_size=count))
    refitted = draw(st.lists(st.booleans(), min_size=count, max_size=count).filter(any))
    return chi2, occam, refitted


@given(fitted_candidates(), degrees)
def test_no_rival_within_the_noise_of_the_winner_is_ruled_out(candidates, noise_degrees):
    chi2, occam, refitted = candidates
    judgements, found = judge(chi2, occam, refitted, noise_degrees)
    ranked = [KEYS.index(keys[0]) for keys, _ in found.ranked]
    winner = next(row for row in ranked if refitted[row])
    for row, value in enumerate(chi2):
        evidence = -0.5 * value - occam[row]
        min_evidence = -0.5 * chi2[winner] - occam[winner] - 0.5 * NOISE_CHI2
        if value < chi2[winner] + NOISE_CHI2 - ROUNDING or evidence > min_evidence + ROUNDING:
            assert judgements[KEYS[row]] == "possible"


@pytest.mark.parametrize("is_refitted", [True, False])
def test_a_rival_far_behind_is_ruled_out(is_refitted):
    judgements, _ = judge([100.0, 200.0], [0.0, 0.0], [True, is_refitted], KNOWN_DEGREES)
    assert judgements[KEYS[1]] == "ruled out"


def test_nothing_is_ruled_out_where_nothing_could_be_compared():
    found = Probabilities(0.005, 0.995, dict.fromkeys([(KEYS[0],)], 0.0))
    score = Score(Hypothesis(KEYS[0], KEYS[0], ({},), ()), {}, 500.0, (1.0,), (0,), 1.0, 1.0)
    selection = Selection((), Evidence(found, ()), Detection((score,), SimpleNamespace(), 0.0), 1e5)
    assert judge_candidates(selection, {})[0].verdict == "possible"


@given(st.floats(0.0, 1e4), st.floats(0.0, 1e4))
def test_a_larger_ratio_has_more_evidence_where_it_counts(first, second):
    low, high = sorted((first, second))
    if low > 1.0:
        assert compute_score_evidence(low) <= compute_score_evidence(high)
