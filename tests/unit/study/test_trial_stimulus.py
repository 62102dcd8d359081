"""Stimuli of trials: intervals on one time line, own frames with any value as a factor, and correct answers."""

import json

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.study.presenter import VirtualPresenter
from optodrive.study.study_file import Study, load_study
from optodrive.study.trial_list import ListedTrial, list_trials
from optodrive.study.trial_stimulus import (
    build_stimulus,
    check_stimuli,
    find_chosen_interval,
    find_correct_answer,
    resolve_intervals,
)

CONFIG = load_config()
TRAIN = {"pixel": 218, "start_s": 0.0, "duration_s": 0.2, "pulse_width_s": 0.004, "gap_s": 0.016, "power_w": 2.0}
TABLE = {
    "format": "optodrive-study",
    "version": 2,
    "name": "any",
    "title": "Any",
    "seed": 5,
    "pause_s": 0.0,
    "response": {"kind": "choice", "question": "Which?", "answers": ["x", "y"]},
}
EMPTY = {
    "stimulus": {"pattern": "vibration", "parameters": {"seconds": 0.5, "height_um": 90.0}, "gap_s": 0.4},
    "intervals": [{"name": "vibration"}, {"name": "empty", "nothing": True}],
    "factors": {"rate_hz": [25.0]},
}


def build_study(**changes):
    return Study.model_validate(TABLE | changes)


def build_trial(condition, intervals=(), is_catch=False):
    return ListedTrial("main", "main", is_catch, condition, intervals)


def build(study, trial):
    return build_stimulus(study, trial, trial.condition, CONFIG)


def test_intervals_follow_each_other_on_one_time_line():
    study = load_study("gap-detection")
    stimulus = build(study, build_trial({"gap_ms": 40}, ("gap", "continuous")))
    assert [each.name for each in stimulus.intervals] == ["gap", "continuous"]
    times_s = [time_s for _, start_s, end_s in stimulus.intervals for time_s in (start_s, end_s)]
    assert times_s == pytest.approx([0.0, 0.84, 1.44, 2.24])
    assert [train.start_s for train in stimulus.sequence.trains] == pytest.approx([0.0, 0.44, 1.44, 1.84])
    swapped = build(study, build_trial({"gap_ms": 40}, ("continuous", "gap")))
    assert [train.start_s for train in swapped.sequence.trains] == pytest.approx([0.0, 0.4, 1.4, 1.84])


def test_an_empty_interval_lasts_as_long_as_the_stimulus():
    study, condition = build_study(**EMPTY), {"rate_hz": 25.0}
    for order, start_s in ((("empty", "vibration"), 0.9), (("vibration", "empty"), 0.0)):
        stimulus = build(study, build_trial(condition, order))
        (train,) = stimulus.sequence.trains
        assert train.start_s == pytest.approx(start_s)
        assert stimulus.duration_s == pytest.approx(1.4)


@pytest.fixture(scope="module")
def presenter():
    presenter = VirtualPresenter(DisplayModel.from_config(CONFIG))
    yield presenter
    presenter.close()


@pytest.mark.parametrize(("order", "lead_s"), [(("empty", "vibration"), 0.9), (("vibration", "empty"), 0.0)])
def test_an_empty_interval_takes_its_time_on_the_board(presenter, order, lead_s):
    stimulus = build(build_study(**EMPTY), build_trial({"rate_hz": 25.0}, order))
    before_s = presenter._boards.now_s
    shown = presenter.present(stimulus)
    assert shown.onset_s - before_s == pytest.approx(lead_s + 0.05, abs=0.03)
    end_s = shown.onset_s + shown.duration_s
    assert end_s == pytest.approx(before_s + 0.05 + 1.4, abs=0.06)
    assert presenter._boards.now_s >= end_s - 0.01
    silent = {name: (start_s, end_s) for name, start_s, end_s in shown.intervals}["empty"]
    assert not np.any((shown.start_s > silent[0] + 1e-3) & (shown.start_s < silent[1] - 1e-3))


def test_nothing_has_no_pulse_and_takes_its_time(presenter):
    study = build_study(
        stimulus={"pattern": "vibration", "parameters": {"seconds": 0.5}},
        factors={"rate_hz": [20.0]},
        catch={"trials": 1},
    )
    before_s = presenter._boards.now_s
    shown = presenter.present(build(study, build_trial({"rate_hz": 20.0}, is_catch=True)))
    assert (shown.onset_s, len(shown.pixel), shown.fault) == (None, 0, None)
    assert shown.duration_s == pytest.approx(0.5)
    assert presenter._boards.now_s - before_s == pytest.approx(0.5, abs=0.02)


def test_own_frames_are_read_beside_the_study_with_any_value_as_a_factor(tmp_path):
    (tmp_path / "taps.json").write_text(json.dumps({"trains": [TRAIN, {**TRAIN, "start_s": 0.5}]}))
    study = """
format = "optodrive-study"
version = 2
name = "any"
title = "Any"
seed = 1
pause_s = 0.0
[stimulus]
frames = "taps.json"
[factors]
"trains.1.start_s" = [0.3, 0.6]
"trains.*.power_w" = [1.0, 2.0]
[response]
kind = "number"
question = "How strong?"
"""
    path = tmp_path / "study.toml"
    path.write_text(study)
    known = load_study(str(path))
    check_stimuli(known, CONFIG)
    starts = set()
    for trial in list_trials(known, "1"):
        first, second = build(known, trial).sequence.trains
        assert first.power_w == second.power_w == trial.condition["trains.*.power_w"]
        assert second.start_s == trial.condition["trains.1.start_s"]
        starts.add(second.start_s)
    assert starts == {0.3, 0.6}
    path.write_text(study.replace("trains.1.start_s", "trains.7.start_s"))
    with pytest.raises(InputError, match=r"trains.7.start_s: got 'trains.7.start_s', expected the place of a value"):
        check_stimuli(load_study(str(path)), CONFIG)
    path.write_text(study.replace("[0.3, 0.6]", "[0.3, 0.1]"))
    with pytest.raises(InputError, match=r"frames: trains"):
        check_stimuli(load_study(str(path)), CONFIG)
    path.write_text(study.replace("taps.json", "none.json"))
    with pytest.raises(InputError, match=r"none.json: got 'No such file or directory'"):
        load_study(str(path))


def test_an_interval_takes_precedence_over_a_factor_and_a_named_factor_over_both():
    study = build_study(
        stimulus={"pattern": "vibration", "parameters": {"seconds": 0.2}, "gap_s": 0.3},
        intervals=[{"name": "a", "parameters": {"rate_hz": 20.0}}, {"name": "b"}],
        factors={"rate_hz": [30.0], "a.height_um": [50.0], "pair": ["same", "other"]},
        levels={"pair": {"other": {"parameters": {"height_um": 90.0}}}},
    )
    for pair, height_um in (("same", None), ("other", 90.0)):
        condition = {"rate_hz": 30.0, "a.height_um": 50.0, "pair": pair}
        first, second = resolve_intervals(study, build_trial(condition, ("a", "b")), condition)
        assert first.parameters == {"seconds": 0.2, "rate_hz": 20.0, "height_um": 50.0}
        assert (second.parameters.get("height_um"), second.parameters["rate_hz"]) == (height_um, 30.0)
        assert second.gap_s == 0.3


def test_a_catch_trial_shows_one_interval_in_all_places():
    study = load_study("frequency-discrimination")
    trial = build_trial({"rate_hz": 50.0}, ("comparison", "standard"), is_catch=True)
    first, second = resolve_intervals(study, trial, trial.condition)
    assert first.parameters == second.parameters == {"height_um": 100.0, "seconds": 0.5, "rate_hz": 25.0}
    assert find_correct_answer(study, trial, trial.condition) is None


RULES = [
    ({"correct_interval": "b"}, ("a", "b"), "y", "y"),
    ({"correct_interval": "b"}, ("b", "a"), "x", "x"),
    ({"correct_largest": "rate_hz"}, ("b", "a"), "x", "x"),
    ({"correct_largest": "rate_hz"}, ("a", "a"), "x", None),
]


@pytest.mark.parametrize(("rule", "order", "answer", "correct"), RULES)
def test_the_correct_answer_by_place(rule, order, answer, correct):
    study = build_study(
        stimulus={"pattern": "vibration"},
        intervals=[{"name": "a", "parameters": {"rate_hz": 20.0}}, {"name": "b"}],
        factors={"rate_hz": [30.0]},
        response=TABLE["response"] | rule | {"chance_level": 0.5},
    )
    trial = build_trial({"rate_hz": 30.0}, order)
    assert find_correct_answer(study, trial, trial.condition) == correct
    assert find_chosen_interval(study, trial, answer) == order["xy".index(answer)]


def test_an_oddball_is_one_of_three_and_the_first_of_two_is_named():
    odd = build_study(
        stimulus={"pattern": "vibration"},
        intervals=[{"name": "usual", "count": 2, "parameters": {"rate_hz": 20.0}}, {"name": "odd"}],
        factors={"rate_hz": [30.0]},
        repetitions=6,
        order={"intervals": "random"},
        response={
            "kind": "choice",
            "question": "?",
            "answers": ["1", "2", "3"],
            "correct_interval": "odd",
            "chance_level": 0.3333,
        },
    )
    found = [find_correct_answer(odd, trial, trial.condition) for trial in list_trials(odd, "1")]
    assert sorted(found) == ["1", "1", "2", "2", "3", "3"]
    first = load_study("temporal-order")
    trial = build_trial({"gap_s": 0.1}, ("right", "left"))
    assert find_correct_answer(first, trial, trial.condition) == "right"
    assert find_chosen_interval(first, trial, "right") is None
