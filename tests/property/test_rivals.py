"""Probabilities of explanations: they sum to one, and no rival within the noise of the winner is ruled out."""

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.core.types.discrepancy import Probabilities
from optodrive.lab.diagnosis import candidate_judgement
from optodrive.lab.diagnosis.candidate_judgement import judge_candidates
from optodrive.lab.diagnosis.detection import NOISE_KNOWN_DEGREES, Detection, Score
from optodrive.lab.diagnosis.evidence import Explanation, compute_probabilities, compute_score_evidence
from optodrive.lab.diagnosis.model_selection import Verdict
from optodrive.physics.hypothesis import Hypothesis
from optodrive.physics.terms import discover_terms

KEYS = sorted(discover_terms())
NOISE_OF_EVIDENCE = 3.0
"""Difference of log evidence, 6 in χ², that noise alone gives."""
evidences = st.lists(st.floats(-50.0, 1e6), min_size=2, max_size=len(KEYS))
degrees = st.sampled_from([8, 20, NOISE_KNOWN_DEGREES])


def explain(values, none_of_these, noise_degrees):
    """Return the probabilities of causes with these log evidences, beside no effect and something else."""
    some = [Explanation((key,), -4.0, value) for key, value in zip(KEYS, values, strict=False)]
    others = [Explanation((), -0.7, 0.0), Explanation((), -2.3, none_of_these, own_share=0.0)]
    return compute_probabilities([*some, *others], noise_degrees)


@given(evidences, st.floats(-50.0, 1e6), degrees)
def test_probabilities_sum_to_one(values, none_of_these, noise_degrees):
    found = explain(values, none_of_these, noise_degrees)
    every = [found.no_effect, found.none_of_these, *found.causes.values()]
    assert all(0.0 <= item <= 1.0 for item in every)
    assert sum(every) == pytest.approx(1.0)
    both = found.combine(Probabilities(0.5, 0.2, {("mirror_lag",): 0.3}))
    assert both.no_effect + both.none_of_these + sum(both.causes.values()) == pytest.approx(1.0)


def judge(values, noise_degrees):
    """Return the judgement of each cause beside the others."""
    found = explain(values, 0.0, noise_degrees)
    scores = tuple(
        Score(Hypothesis(key, key, ({},), ()), {}, 2.0 * value + 100.0, (1.0,), (0,), 1.0, 1.0)
        for key, value in zip(KEYS, values, strict=False)
    )
    detection = Detection(scores, SimpleNamespace(), 0.0)
    chosen = SimpleNamespace(hypotheses=())
    verdict = Verdict("cause", (), found, chosen, (), detection)
    return {item.cause: item.verdict for item in judge_candidates(verdict, {})}


@pytest.fixture(autouse=True)
def without_limits(monkeypatch):
    monkeypatch.setattr(candidate_judgement, "_describe_detection_limit", lambda score: "")


@given(evidences, st.data(), degrees)
def test_no_rival_within_the_noise_of_the_winner_is_ruled_out(values, data, noise_degrees):
    winner = max(range(len(values)), key=values.__getitem__)
    near = data.draw(st.integers(0, len(values) - 1).filter(lambda row: row != winner))
    values[near] = values[winner] - data.draw(st.floats(0.0, NOISE_OF_EVIDENCE))
    found = explain(values, 0.0, noise_degrees)
    if found.causes[(KEYS[winner],)] < 0.05:  # no winner
        return
    assert judge(values, noise_degrees)[KEYS[near]] == "possible"


def test_a_rival_far_behind_is_ruled_out():
    assert judge([100.0, 50.0], NOISE_KNOWN_DEGREES)[KEYS[1]] == "ruled out"


@given(st.floats(0.0, 1e4), st.floats(0.0, 1e4))
def test_a_larger_ratio_has_more_evidence_where_it_counts(first, second):
    low, high = sorted((first, second))
    if low > 1.0:
        assert compute_score_evidence(low) <= compute_score_evidence(high)
