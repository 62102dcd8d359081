"""Psychometric functions of the shipped designs with levels: coverage of their intervals, and what is flagged."""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import norm

from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.study.observers import Observer, Participant
from optodrive.study.power import RememberedDisplay
from optodrive.study.session import build_threshold_model
from optodrive.study.study_file import load_study
from optodrive.study.threshold import ThresholdModel
from optodrive.study.trial_list import list_trials
from optodrive.study.trial_stimulus import build_stimulus, find_correct_answer

COVERAGE = (0.92, 0.98)
WAY = norm.ppf(1.0 - 0.5 * np.exp(-1.0))
"""Difference in standard deviations at which 63 % of the way from 1/2 to certainty is reached."""


class Noise(NamedTuple):
    """Noise of one interval of a typical simulated participant (docs/explanation/perception.md), in what is felt."""

    sd: float
    felt: object
    level: object


DESIGNS = {
    "frequency-discrimination": Noise(0.2, lambda hz: np.log(1.0 + hz / 25.0), lambda felt: 25.0 * np.expm1(felt)),
    "gap-detection": Noise(10.0, lambda ms: ms, lambda felt: felt),
    "two-point": Noise(2.0, lambda mm: mm, lambda felt: felt),
    "temporal-order": Noise(30.0, lambda ms: ms, lambda felt: felt),
}


class Coverage(NamedTuple):
    """Participants whose answers bound the threshold, those whose interval holds it, and those with both ends."""

    bounded: int
    held: int
    closed: int
    flagged: int


@pytest.fixture(scope="module")
def display():
    return DisplayModel.from_config(load_config())


def find_threshold(name, acuity):
    """Return the level at which two intervals are told apart, by the closed form of the participant's noise."""
    noise = DESIGNS[name]
    return float(noise.level(WAY * np.sqrt(2.0) * noise.sd / acuity))


def find_acuity(name, threshold):
    noise = DESIGNS[name]
    return float(WAY * np.sqrt(2.0) * noise.sd / noise.felt(threshold))


def run_participant(study, presenter, shown, participant, number, seed):
    """Return level and correctness of the main trials of one session."""
    observer, rng = Observer(study, presenter.display, participant), np.random.default_rng((seed, number))
    answered, levels = [], study.threshold_levels
    for listed in list_trials(study, f"{seed}x{number}"):
        if listed.phase != "main" or listed.is_catch:
            continue
        key = repr((listed.condition, listed.intervals))
        if key not in shown:
            shown[key] = presenter.present(build_stimulus(study, listed, listed.condition, presenter.config))
        is_correct = observer.answer(shown[key], rng) == find_correct_answer(study, listed, listed.condition)
        answered.append((levels.index(listed.condition[study.threshold_of]), is_correct))
    return answered


def judge(name, display, count, seed, model=None):
    """Return how often intervals hold the thresholds of participants whom the levels of a design enclose."""
    study, presenter, shown = load_study(name), RememberedDisplay(display), {}
    model = build_threshold_model(study) if model is None else model
    rng, ends = np.random.default_rng(seed), np.log(study.threshold_levels)[[0, -1]]
    held, closed, bounded, flagged = 0, 0, 0, 0
    for number in range(count):
        truth = float(np.exp(rng.uniform(*ends)))
        participant = Participant(acuity=find_acuity(name, truth))
        found = model.estimate(run_participant(study, presenter, shown, participant, number, seed))
        bounded += found.low is not None or found.high is not None
        closed += found.low is not None and found.high is not None
        flagged += bool(found.flags)
        is_held = (found.low or 0.0) <= truth <= (found.high or np.inf)
        held += is_held and (found.low is not None or found.high is not None)
    return Coverage(bounded, held, closed, flagged)


@pytest.mark.slow
@pytest.mark.parametrize("name", DESIGNS)
def test_intervals_of_a_thousand_participants_cover(name, display):
    """Undetermined thresholds count as neither held nor missed."""
    found = judge(name, display, 1000, load_study(name).seed)
    assert COVERAGE[0] <= found.held / found.bounded <= COVERAGE[1], found
    assert found.bounded >= 900


def test_intervals_cover_and_those_of_another_task_do_not(display):
    name = "gap-detection"
    found = judge(name, display, 50, 1)
    assert found.held >= 0.88 * found.bounded
    levels = load_study(name).threshold_levels
    of_another = judge(name, display, 50, 1, ThresholdModel(levels, 0.25))
    assert of_another.held < 0.8 * of_another.bounded


@cache
def draw_estimates(name, kind, count=40):
    """Return estimates from answers that a rule draws, with the number of trials of a design."""
    study, found = load_study(name), []
    model, trials = build_threshold_model(study), study.repetitions
    levels = np.repeat(np.arange(len(study.threshold_levels)), trials)
    middle = np.sqrt(study.threshold_levels[0] * study.threshold_levels[-1])
    for number in range(count):
        rng = np.random.default_rng((study.seed, number))
        lapse = 0.2 if kind == "lapses" else 0.02
        way = 1.0 - np.exp(-((np.array(study.threshold_levels) / (0.6 * middle)) ** 1.5))
        right = 0.5 + (0.5 - lapse) * way
        share = {
            "all-correct": np.ones_like(right),
            "all-wrong": np.zeros_like(right),
            "exchanged-keys": 1.0 - right,
            "guessing": np.full_like(right, 0.5),
        }.get(kind, right)
        answered = zip(levels.tolist(), (rng.random(len(levels)) < share[levels]).tolist(), strict=True)
        found.append(model.estimate(list(answered)))
    return found


@pytest.mark.parametrize("name", DESIGNS)
def test_answers_without_a_threshold_are_flagged(name):
    shares = {}
    for kind in ("all-correct", "all-wrong", "exchanged-keys", "guessing"):
        found = draw_estimates(name, kind)
        shares[kind] = np.mean([kind in each.flags for each in found])
        assert all(each.threshold is None for each in found if kind in each.flags)
    assert shares["all-correct"] == shares["all-wrong"] == 1.0
    assert min(shares["exchanged-keys"], shares["guessing"]) >= 0.9, shares
    named = [np.mean(["lapses" in each.flags for each in draw_estimates(name, kind)]) for kind in ("lapses", None)]
    assert named[0] > 3.0 * named[1], named
