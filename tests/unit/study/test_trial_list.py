"""The trial list as a function of study, participant, session and seed, and which trials practice and rules exclude."""

from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optodrive.core.errors import InputError
from optodrive.study.study_file import Study, load_study
from optodrive.study.trial_list import (
    ListedTrial,
    build_latin_row,
    find_exclusion,
    find_session_exclusion,
    is_practice_over,
    list_trials,
)

ORDERS = st.sampled_from(["random", "fixed", "latin-square"])
RESPONSE = {"kind": "choice", "question": "Which?", "answers": ["1", "2"], "correct_interval": "b", "chance_level": 0.5}


def build_study(**changes):
    table = {
        "format": "optodrive-study",
        "version": 2,
        "name": "any",
        "title": "Any",
        "seed": 5,
        "pause_s": 0.0,
        "stimulus": {"pattern": "vibration"},
        "intervals": [{"name": "a", "parameters": {"rate_hz": 20.0}}, {"name": "b"}],
        "factors": {"rate_hz": [30.0, 40.0, 50.0]},
        "response": RESPONSE,
    }
    return Study.model_validate(table | changes)


@st.composite
def studies(draw):
    counts = draw(st.lists(st.integers(1, 4), min_size=1, max_size=3))
    blocks = [
        {
            "name": f"block-{k}",
            "repetitions": draw(st.integers(1, 3)),
            "factors": {"height_um": [10.0 * each for each in range(1, count + 1)]},
        }
        for k, count in enumerate(counts)
    ]
    changes = {
        "seed": draw(st.integers(0, 1000)),
        "sessions": draw(st.integers(1, 3)),
        "blocks": blocks,
        "order": {
            "trials": draw(ORDERS),
            "blocks": draw(ORDERS),
            "intervals": draw(st.sampled_from(["random", "fixed"])),
        },
    }
    if draw(st.booleans()):
        changes["catch"] = {"trials": draw(st.integers(1, 5)), "shows": "a"}
    if draw(st.booleans()):
        trials_min = draw(st.integers(1, 5))
        changes["practice"] = {
            "trials": trials_min,
            "criterion": 0.5,
            "trials_max": trials_min + draw(st.integers(0, 9)),
        }
    return build_study(**changes)


@settings(max_examples=60, deadline=None)
@given(studies(), st.integers(1, 99), st.data())
def test_every_list_has_what_the_study_states(study, code, data):
    session = data.draw(st.integers(1, study.sessions))
    trials = list_trials(study, f"p{code}", session)
    assert trials == list_trials(study, f"p{code}", session)
    assert trials == [ListedTrial.from_record(trial.to_record()) for trial in trials]
    practice = 0 if study.practice is None else study.practice.trials_max
    assert [trial.phase for trial in trials] == ["practice"] * practice + ["main"] * study.trial_count
    main = trials[practice:]
    names = [name for name, following in pairwise([*(trial.block for trial in main), None]) if name != following]
    assert sorted(names) == [block.name for block in study.blocks]
    for block in study.blocks:
        mine = [trial for trial in main if trial.block == block.name]
        assert sum(trial.is_catch for trial in mine) == (0 if study.catch is None else study.catch.trials)
        counted = Counter(tuple(trial.condition.items()) for trial in mine if not trial.is_catch)
        assert counted == {
            (("rate_hz", rate), ("height_um", height)): block.repetitions
            for rate in study.factors["rate_hz"]
            for height in block.factors["height_um"]
        }
        orders = Counter(trial.intervals for trial in mine if not trial.is_catch)
        if study.order.intervals == "fixed":
            assert set(orders) == {("a", "b")}
        else:
            assert abs(orders["a", "b"] - orders["b", "a"]) <= 1
    for trial in main:
        assert trial.is_catch or set(trial.intervals) == {"a", "b"}


def test_seed_participant_and_session_each_change_a_random_list():
    study = build_study(repetitions=10, sessions=2)
    lists = [list_trials(study, "1"), list_trials(study, "2"), list_trials(study, "1", 2)]
    lists.append(list_trials(study.model_copy(update={"seed": 6}), "1"))
    assert len({str(each) for each in lists}) == 4


@pytest.mark.parametrize("count", range(2, 10))
def test_in_a_latin_square_every_condition_is_at_every_place_and_after_every_other_equally_often(count):
    rows = [build_latin_row(count, row) for row in range(count if count % 2 == 0 else 2 * count)]
    share = len(rows) // count
    for places in zip(*rows, strict=True):
        assert Counter(places) == dict.fromkeys(range(count), share)
    follow = Counter(pair for row in rows for pair in pairwise(row))
    assert follow == {(a, b): share for a in range(count) for b in range(count) if a != b}


def test_blocks_of_a_latin_square_are_balanced_over_consecutive_codes():
    study = load_study("height-threshold")
    orders = [list(dict.fromkeys(trial.block for trial in list_trials(study, f"{code:02}"))) for code in range(1, 7)]
    for place in range(3):
        assert set(Counter(order[place] for order in orders).values()) == {2}
    with pytest.raises(InputError, match="--participant: got 'ab', expected a code with a number"):
        list_trials(study, "ab")


def record(phase="main", is_correct=True, is_catch=False, answer="1", response_time_s=1.0):
    return {
        "phase": phase,
        "is_correct": is_correct,
        "is_catch": is_catch,
        "answer": answer,
        "response_time_s": response_time_s,
    }


def test_practice_goes_on_until_its_criterion_or_its_largest_number():
    study = build_study(practice={"trials": 4, "criterion": 0.75, "trials_max": 8})
    right, wrong = record("practice"), record("practice", is_correct=False)
    assert not is_practice_over(study, [right] * 3)
    assert is_practice_over(study, [right] * 3 + [wrong])
    assert not is_practice_over(study, [right] * 2 + [wrong] * 2)
    assert is_practice_over(study, [wrong] * 4 + [right] * 3 + [wrong])
    assert is_practice_over(study, [wrong] * 8)
    assert find_session_exclusion(study, [wrong] * 8 + [record()]) == "practice"
    assert find_session_exclusion(study, [wrong] * 8) is None  # no trial counts yet
    assert find_session_exclusion(study, [wrong] * 5 + [right] * 3 + [record()]) is None


def test_trials_are_excluded_by_response_time_and_sessions_by_catch_trials():
    study = build_study(
        response=RESPONSE | {"min_s": 0.2, "max_s": 5.0}, catch={"trials": 4, "answer": "1", "errors_max": 0.25}
    )
    assert find_exclusion(study, record(response_time_s=0.19)) == "too_fast"
    assert find_exclusion(study, record(answer=None, response_time_s=None)) == "no_answer"
    assert find_exclusion(study, record()) is None
    caught, missed = record(is_catch=True), record(is_catch=True, is_correct=False)
    assert find_session_exclusion(study, [caught] * 3 + [missed]) is None
    assert find_session_exclusion(study, [caught] * 2 + [missed] * 2) == "catch_trials"
