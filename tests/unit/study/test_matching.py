"""Comparisons of places: their choice, the estimate from answers, resumption, and the study around them."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.device.sensitivity_map import load_sensitivity_map, replace_sensitivity_map
from optodrive.study.matching import MatchingModel, spread_places
from optodrive.study.observers import Observer, Participant, draw_sensitivity
from optodrive.study.presenter import VirtualPresenter
from optodrive.study.results import compute_variation, write_sensitivity
from optodrive.study.session import SimulatedRespondent, build_matching_model, run_session
from optodrive.study.study_file import EXPERIMENTS, load_study
from optodrive.study.trial_log import TrialLog

DISPLAY = DISPLAYS["display-437"]
LAYOUT = DISPLAY.layout
TRIALS = 12


def build_model():
    return MatchingModel(LAYOUT.x_m, LAYOUT.y_m, 60, 6.0)


def answer_by(truth, model, trials, names_weaker=False):
    """Run a matching with a participant who errs never, or always."""
    answers = []
    for trial in range(trials):
        shown = model.choose(answers, bool(trial % 2))
        first, second = (
            truth[pixel] * (1.5 + intensity)
            for pixel, intensity in ((shown.first, shown.first_intensity), (shown.second, shown.second_intensity))
        )
        answers.append((shown, bool(second > first) != names_weaker))
    return answers


def test_places_are_spread_over_the_display_up_to_its_border():
    position_m = np.column_stack([LAYOUT.x_m, LAYOUT.y_m])
    places = spread_places(position_m, 60)
    assert len(set(places.tolist())) == 60
    nearest_m = np.linalg.norm(position_m[:, None] - position_m[places][None], axis=2).min(axis=1)
    assert nearest_m.max() < 2.5 * DISPLAY.config.display.pitch_m
    assert LAYOUT.x_m[places].max() == LAYOUT.x_m.max()
    assert LAYOUT.y_m[places].min() == LAYOUT.y_m.min()
    assert len(spread_places(position_m[:10], 60)) == 10


def test_a_sensitivity_follows_the_answers_and_without_them_nothing_is_claimed():
    truth, model = draw_sensitivity(LAYOUT, 2.0, np.random.default_rng(5)), build_model()
    assert truth.max() / truth.min() == pytest.approx(2.0)
    nothing = model.estimate([])
    assert nothing.sensitivity == pytest.approx(1.0)
    assert nothing.sigma.min() > 0.1
    found = model.estimate(answer_by(truth, model, 150))
    before = compute_variation(truth, 1.0, 8.0)
    assert before > 0.15
    # The model allows for errors, and so learns slowly from a participant without any.
    assert compute_variation(truth, found.sensitivity, 8.0) < 0.5 * before
    assert np.log(found.sensitivity).mean() == pytest.approx(0.0, abs=1e-9)
    assert found.sigma.mean() < 0.5 * nothing.sigma.mean()
    reversed_map = model.estimate(answer_by(truth, build_model(), 150, names_weaker=True))
    assert compute_variation(truth, reversed_map.sensitivity, 8.0) > before


def test_a_comparison_shows_what_is_predicted_to_be_felt_alike():
    truth, model = draw_sensitivity(LAYOUT, 2.0, np.random.default_rng(6)), build_model()
    first = model.choose([], False)
    assert first.first_intensity == first.second_intensity == 6.0
    later = model.choose(answer_by(truth, model, 150), False)
    ratio = truth[later.first] * (1.5 + later.first_intensity) / truth[later.second] / (1.5 + later.second_intensity)
    assert abs(np.log(ratio)) < 0.1
    swapped = model.choose(answer_by(truth, build_model(), 150), True)
    assert (swapped.first, swapped.second) == (later.second, later.first)


def test_the_choice_follows_from_the_answers_alone():
    truth, continued = draw_sensitivity(LAYOUT, 2.0, np.random.default_rng(7)), build_model()
    answers = answer_by(truth, continued, 120)
    assert continued.choose(answers, False) == build_model().choose(answers, False)


def test_a_sensitivity_that_does_not_vary_is_1_also_on_one_pixel():
    for name, sensitivity_range in (("display-437", 1.0), ("display-1", 1.0), ("display-1", 2.0)):
        layout = DISPLAYS[name].layout
        drawn = draw_sensitivity(layout, sensitivity_range, np.random.default_rng(1))
        np.testing.assert_array_equal(drawn, np.ones(len(layout)))


def test_a_display_of_one_pixel_has_nothing_to_compare():
    with pytest.raises(InputError, match="got 'a display of 1 pixel', expected at least two pixels"):
        build_matching_model(load_study("equalisation").matching, DISPLAYS["display-1"].layout)


class EndingPresenter(VirtualPresenter):
    """Ends the run before a presentation, as a crash does."""

    presentations_left = 10**6

    def present(self, stimulus, on_begin):
        self.presentations_left -= 1
        if self.presentations_left < 0:
            raise KeyboardInterrupt
        return super().present(stimulus, on_begin)


def write_study(folder, trials=TRIALS):
    text = (EXPERIMENTS / "equalisation.toml").read_text()
    path = folder / "short.toml"
    path.write_text(text.replace("trials = 1000", f"trials = {trials}"))
    return load_study(str(path))


def run(study, path, presentations=10**6):
    truth, presenter = draw_sensitivity(LAYOUT, 2.0, np.random.default_rng(8)), EndingPresenter(DISPLAY)
    presenter.presentations_left = presentations
    respondent = SimulatedRespondent(Observer(study, DISPLAY, Participant(), truth), 1, 1, presenter)
    with TrialLog(path, study, "p1") as log:
        log.begin_run("test")
        try:
            run_session(study, log, presenter, respondent, matching=build_matching_model(study.matching, LAYOUT))
        except KeyboardInterrupt:
            assert len(log.trials) == presentations
        presenter.close()
        return [log.trials[index] for index in sorted(log.trials)]


def test_a_session_that_was_interrupted_goes_on_with_the_same_comparisons(tmp_path):
    study = write_study(tmp_path)
    whole = run(study, tmp_path / "whole.jsonl")
    run(study, tmp_path / "parts.jsonl", presentations=5)
    parts = run(study, tmp_path / "parts.jsonl")
    assert len(whole) == len(parts) == TRIALS
    assert parts[5]["attempt"] == 2
    assert [record["condition"] for record in whole[:6]] == [record["condition"] for record in parts[:6]]
    for record in parts:
        pixels = record["presentations"][-1]["executed"]["pixel"]
        shown = [record["condition"]["first"], record["condition"]["second"]]
        assert list(dict.fromkeys(pixels)) == shown
        assert record["is_correct"] is None


def test_the_map_of_a_session_is_one_that_a_configuration_may_name(tmp_path):
    study = write_study(tmp_path)
    records = run(study, tmp_path / "log.jsonl")
    path, written = write_sensitivity(tmp_path, study, study.matching, "p1", records, DISPLAY.config)
    known = load_sensitivity_map(replace_sensitivity_map(DISPLAY.config, path))
    assert (known.participant, known.trials) == ("p1", TRIALS)
    assert known.sensitivity == pytest.approx(written.sensitivity, rel=1e-4)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            'pattern = "comparison"',
            'pattern = "detection"',
            "stimulus: got 'detection', expected the pattern comparison",
        ),
        ('answers = ["first", "second"]', 'answers = ["one", "two"]', "expected first, second, without"),
        ("[matching]", "[factors]\nfirst = [1]\n\n[matching]", "factors: got"),
        (
            "[matching]",
            '[procedure]\nkind = "staircase"\nparameter = "x"\nlevels = [1.0, 2.0, 3.0]\ntrials = 3\n\n[matching]',
            "procedure: got a section",
        ),
        ("pause_s = 0.3", "pause_s = 0.3\nrepetitions = 2", "repetitions: got 2"),
        ("trials = 1000", "trials = 0", "matching.trials: got 0"),
        ("places = 60", "places = 1", "matching.places: got 1"),
        ("sensitivity_range = 2.0", "sensitivity_range = 0.5", "sensitivity_range: got 0.5"),
    ],
)
def test_a_wrong_matching_is_told_in_one_line(tmp_path, old, new, says):
    text = (EXPERIMENTS / "equalisation.toml").read_text()
    assert old in text
    path = tmp_path / "study.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as refused:
        load_study(str(path))
    assert says in str(refused.value), str(refused.value)
    assert "\n" not in str(refused.value)
