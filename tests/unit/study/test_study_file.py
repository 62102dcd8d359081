"""Study files: the paper's designs, and what a wrong file is told."""

from collections import Counter

import pytest

from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.study.study_file import EXPERIMENTS, list_shipped_studies, load_study
from optodrive.study.trial_list import list_trials

TRIALS = {1: 20, 2: 36, 3: 45, 4: 72, 5: 24, 6: 30}
"""Trials per participant (Text S5)."""
TOTALS = {1: 200, 2: 360, 3: 450, 4: 720, 5: 240, 6: 300}
CORRECT_PERCENT = {1: 100.0, 2: 94.7, 3: 78.4, 5: 89.6, 6: 96.3}
CHANCE_PERCENT = {1: 25.0, 2: 50.0, 3: 11.1, 5: 33.3, 6: 16.7}


def test_the_six_experiments_are_shipped():
    assert list_shipped_studies() == ["detection", "equalisation", *(f"experiment-{number}" for number in range(1, 7))]


@pytest.mark.parametrize("number", range(1, 7))
def test_a_design_has_the_papers_counts_and_levels(number):
    study = load_study(f"experiment-{number}")
    assert study.trial_count == study.published.trials_per_participant == TRIALS[number]
    assert study.published.trials == TOTALS[number]
    if number == 4:
        assert study.response.kind == "magnitude"
        return
    assert round(100 * study.published.correct / study.published.trials, 1) == CORRECT_PERCENT[number]
    assert round(100 * study.response.chance_level, 1) == CHANCE_PERCENT[number]
    assert len(study.response.answers) == round(1 / study.response.chance_level)


def test_the_papers_contradiction_about_trials_is_named():
    (counts, _) = load_study("experiment-2").published.contradictions
    assert "30 trials" in counts
    assert "36 per participant" in counts


@pytest.mark.parametrize("number", range(1, 7))
def test_every_condition_is_a_stimulus_of_the_display(number):
    study, config = load_study(f"experiment-{number}"), load_config()
    for condition in study.conditions:
        assert build_pattern(study.stimulus.pattern, {**study.stimulus.parameters, **condition}, config).trains


def test_the_order_has_every_condition_as_often_and_differs_between_participants():
    study = load_study("experiment-5")
    order = list_trials(study, "01")
    assert Counter(str(trial.condition) for trial in order) == {str(condition): 4 for condition in study.conditions}
    assert order == list_trials(study, "01")
    assert order != list_trials(study, "02")
    assert order != list_trials(study.model_copy(update={"seed": 9}), "01")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("version = 2", "version = 1", "version: got 1, expected 2, the one this release reads"),
        ("chance_level = 0.25", "chance_level = 0.5", "response.chance_level: got 0.5, expected 0.2500"),
        ('correct_factor = "direction"', 'correct_factor = "speed"', "correct_factor: got 'speed', expected one of"),
        ("repetitions = 5", "repetitions = 0", "repetitions: got 0"),
        ("repetitions = 5", "repetitons = 5", "nearest is 'repetitions'"),
        (
            'direction = ["left",',
            'direction = ["north",',
            "factors.direction: got 'north', expected one of the answers",
        ),
        ('direction = ["left",', 'direction = ["right",', "factors.direction"),
        (
            'name = "experiment-1"',
            'name = "Experiment 1"',
            "name: got 'Experiment 1', expected small letters and digits",
        ),
        ('direction = ["left",', 'direction = [true, "left",', "factors.direction.0: got True, expected text or a"),
        ('observer = "linear-motion"', 'observer = "intensity"', "an observer whose answers are left, right, up, down"),
        ("seed = 1", 'seed = "1"', "seed: got '1'"),
    ],
)
def test_a_wrong_file_is_told_in_one_line(tmp_path, old, new, says):
    text = (EXPERIMENTS / "experiment-1.toml").read_text()
    assert old in text
    path = tmp_path / "study.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        load_study(str(path))
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_study_is_told_the_shipped_ones():
    with pytest.raises(InputError, match="experiment-1, experiment-2"):
        load_study("experiment-7")
