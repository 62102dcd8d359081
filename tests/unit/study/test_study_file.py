"""Study files: the paper's designs, and what a wrong file is told."""

from collections import Counter

import pytest

from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.study.study_file import EXPERIMENTS, list_shipped_studies, load_study
from optodrive.study.trial_list import list_trials
from optodrive.study.trial_stimulus import check_stimuli

TRIALS = {1: 20, 2: 36, 3: 45, 4: 72, 5: 24, 6: 30}
"""Trials per participant (Text S5)."""
TOTALS = {1: 200, 2: 360, 3: 450, 4: 720, 5: 240, 6: 300}
CORRECT_PERCENT = {1: 100.0, 2: 94.7, 3: 78.4, 5: 89.6, 6: 96.3}
CHANCE_PERCENT = {1: 25.0, 2: 50.0, 3: 11.1, 5: 33.3, 6: 16.7}


def test_the_six_experiments_and_ten_other_designs_are_shipped():
    names = list_shipped_studies()
    assert [name for name in names if name.startswith("experiment-")] == [f"experiment-{k}" for k in range(1, 7)]
    assert len(names) == 18


@pytest.mark.parametrize("name", list_shipped_studies())
def test_a_shipped_study_is_one_of_the_display(name):
    study = load_study(name)
    assert study.name == name
    check_stimuli(study, load_config())


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


EXPERIMENT = [
    ("version = 2", "version = 1", "line 4: version: got 1, expected 2, the one this release reads"),
    ("chance_level = 0.25", "chance_level = 0.5", "response.chance_level: got 0.5, expected 0.2500"),
    ("chance_level = 0.25\n", "", "line 18: response.chance_level: missing, expected 0.2500"),
    ('correct_factor = "direction"', 'correct_factor = "speed"', "correct_factor: got 'speed', expected one of"),
    ("repetitions = 5", "repetitions = 0", "line 8: repetitions: got 0"),
    ("repetitions = 5", "repetitons = 5", "line 8: repetitons: got 'repetitons', expected a known key, nearest is"),
    ('direction = ["left",', 'direction = ["north",', "factors.direction: got 'north', expected one of the answers"),
    ('direction = ["left",', 'direction = ["right",', "line 16: factors.direction"),
    ('name = "experiment-1"', 'name = "Experiment 1"', "name: got 'Experiment 1', expected small letters and digits"),
    ('direction = ["left",', 'direction = [true, "left",', "factors.direction.0: got True, expected text or a"),
    ('observer = "linear-motion"', 'observer = "intensity"', "an observer whose answers are left, right, up, down"),
    ('observer = "linear-motion"', 'observer = "order"', "those of this one are none here"),
    ('observer = "linear-motion"', 'observer = "interval"', "it names one of 0 intervals, the study has 4 answers"),
    ("seed = 1", 'seed = "1"', "line 7: seed: got '1'"),
    ("seed = 1", "seed = 1\nbreak_every = 0", "line 8: break_every: got 0"),
    ("seed = 1", 'seed = 1\nlanguage = "German"', "language: got 'German', expected text of the form"),
    (
        "seed = 1",
        'seed = 1\ntexts = { redy = "x" }',
        "texts.redy: got 'redy', expected a sentence of the page, nearest is",
    ),
    (
        "seed = 1",
        'seed = 1\ntexts = { trial = "Nr." }',
        "texts.trial: got 'Nr.', expected one line with {count} and {n",
    ),
    ("[response]", "[procedure]\n[response]", "line 18: procedure.kind: missing"),
]
DISCRIMINATION = [
    (
        'correct_interval = "comparison"',
        'correct_interval = "third"',
        "response.correct_interval: got 'third', expected",
    ),
    (
        'correct_interval = "comparison"',
        "correct_position = 1",
        "intervals: got 'standard', expected one of the answers",
    ),
    (
        'shows = "standard"',
        'shows = "third"',
        "catch.shows: got 'third', expected one of nothing, standard, comparison",
    ),
    ("[catch]\n", "[catch]\nerrors_max = 0.2\n", "catch.errors_max: got 0.2, expected a catch.answer beside it"),
    ("[catch]\n", '[catch]\nanswer = "none"\n', "catch.answer: got 'none', expected one of the answers"),
    ('answers = ["first", "second"]', 'answers = ["1", "2", "3"]', "response.chance_level: got 0.5"),
    ("trials_max = 24", "trials_max = 3", "practice.trials_max: got 3, expected at least 6"),
    ("trials_max = 24\n", "", "practice.trials_max: got None, expected stated beside a criterion"),
    (
        "factors = { difference_hz = [25] }",
        "factors = { difference = [25] }",
        "practice.factors.difference: got [25], expected a factor",
    ),
    ("gap_s = 0.5", "gap_s = -0.5", "intervals.1.gap_s: got -0.5, expected greater than or equal to 0"),
    (
        'name = "comparison" ',
        'name = "standard" ',
        "intervals: got ['standard', 'standard'], expected names that differ",
    ),
    (
        "[order]",
        '[order]\nblocked_by = "difference"',
        "order.blocked_by: got 'difference', expected a factor, nearest is 'difference_hz'",
    ),
    ("min_s = 0.1", "min_s = 9.0", "response.max_s: got 8.0, expected more than min_s, 9"),
    ('name = "hand"', 'name = "age"', "questions: got ['age', 'age', 'strategy'], expected names that differ"),
    ('answers = ["left", "right", "both"]', "", "questions.1.answers: got [], expected at least two"),
    ("[catch]", "[levels.difference_hz.99]\n[catch]", "levels.difference_hz: got '99', expected a value of the factor"),
    (
        "[catch]",
        "[levels.difference]\nx = {}\n[catch]",
        "levels.difference: got 'difference', expected a factor, nearest is 'difference_hz'",
    ),
    (
        'pattern = "vibration"',
        'pattern = "vibration"\nframes = { trains = [] }',
        "stimulus.frames: got 'a file', expected",
    ),
    ('pattern = "vibration"\n', "", "stimulus.pattern: missing, expected a pattern, or frames"),
    ("[catch]", '[[blocks]]\nname = "A"\n[catch]', "blocks.0.name: got 'A'"),
    ('level = "difference_hz"', 'level = "rate_hz"', "response.level: got 'rate_hz', expected one of difference_hz"),
    ("difference_hz = [2, 5,", 'difference_hz = ["2", 5,', "factors.difference_hz: got '2', expected numbers above 0"),
    ("difference_hz = [2, 5,", "difference_hz = [0, 2, 5,", "factors.difference_hz: got 0, expected numbers above 0"),
    (
        "difference_hz = [25]",
        "difference_hz = [-1]",
        "practice.factors.difference_hz: got -1, expected numbers above 0",
    ),
    (
        "[order]",
        '[order]\nblocked_by = "difference_hz"',
        "order.blocked_by: got 'difference_hz', expected another factor",
    ),
    (
        'kind = "choice"\nquestion = "Which was',
        'kind = "number"\nquestion = "Which was',
        "response.level: got 'difference_hz', expected none: number",
    ),
]
ORDER = [
    ("correct_position = 1\n", "", "response.correct_factor: missing, expected a rule of the correct answer"),
    ('level = "onset_ms"', 'level = "onset"', "response.level: got 'onset', expected one of onset_ms"),
    (
        "[simulation]",
        '[procedure]\nkind = "constant"\nparameter = "x"\nlevels = [1, 2, 3]\ntrials = 9\n[simulation]',
        "response.level: got 'onset_ms', expected none beside [procedure]",
    ),
]


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        *(("experiment-1", *each) for each in EXPERIMENT),
        *(("frequency-discrimination", *each) for each in DISCRIMINATION),
        *(("temporal-order", *each) for each in ORDER),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path, name, old, new, says):
    text = (EXPERIMENTS / f"{name}.toml").read_text()
    assert old in text
    path = tmp_path / "study.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        load_study(str(path))
    message = str(error.value)
    assert says in message
    assert "\n" not in message
    assert message.startswith(f"{path}, line ")
    stated = int(message.removeprefix(f"{path}, line ").partition(":")[0])
    changed = path.read_text().splitlines()
    assert 1 <= stated <= len(changed)


def test_a_level_has_three_values_at_least(tmp_path):
    path, text = tmp_path / "study.toml", (EXPERIMENTS / "temporal-order.toml").read_text()
    path.write_text(
        text.replace("onset_ms = [10", "twice = [1, 2]\nonset_ms = [10").replace('= "onset_ms"', '= "twice"')
    )
    with pytest.raises(InputError, match=r"line [0-9]+: response.level: got 'twice', expected a factor with at"):
        load_study(str(path))
    path.write_text(text)
    assert load_study(str(path)).threshold_levels == (10.0, 20.0, 40.0, 80.0, 160.0)


def test_an_unknown_study_is_told_the_shipped_ones():
    with pytest.raises(InputError, match="experiment-1, experiment-2"):
        load_study("experiment-7")
