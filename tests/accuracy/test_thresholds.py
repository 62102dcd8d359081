"""Thresholds of 200 simulated participants by each procedure: bias, coverage of the 95 % intervals, resumption."""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import norm

from optodrive.device.config_file import load_config
from optodrive.physics.sensation import compute_excitations
from optodrive.planning.display_model import DisplayModel
from optodrive.study.observers import Observer, Participant
from optodrive.study.presenter import VirtualPresenter
from optodrive.study.session import SimulatedRespondent, build_threshold_model, list_answered, run_session
from optodrive.study.study_file import load_study
from optodrive.study.threshold import (
    GRID_MAX,
    LAPSE_RANGE,
    SLOPE_RANGE,
    ThresholdModel,
    draw_constant_levels,
    select_staircase_level,
)
from optodrive.study.trial_list import ListedTrial
from optodrive.study.trial_log import TrialLog
from optodrive.study.trial_stimulus import build_stimulus

LEVELS = tuple(np.geomspace(20.0, 2000.0, 25))
CHANCE = 0.5
PARTICIPANTS = 200
TRIALS = {"quest-plus": 40, "staircase": 60, "constant": 100}
BIAS_MAX, COVERAGE = 0.05, (0.92, 0.98)


class Recovery(NamedTuple):
    """Bias of the geometric mean of estimate / truth, and share of the intervals that hold the truth."""

    bias: float
    coverage: float

    @property
    def are_met(self):
        return abs(self.bias) <= BIAS_MAX and COVERAGE[0] <= self.coverage <= COVERAGE[1]


def select(procedure, model, answered, order):
    if procedure == "constant":
        return order[len(answered)]
    if procedure == "staircase":
        return select_staircase_level(len(model.levels), answered)
    return model.select_informative_level(answered)


@cache
def judge(procedure, seed, chance=CHANCE):
    """Estimate the thresholds of participants drawn from the model's ranges. chance: as the model assumes it."""
    rng, model = np.random.default_rng(seed), ThresholdModel(LEVELS, chance)
    errors, holds = [], []
    for number in range(PARTICIPANTS):
        threshold = np.exp(rng.uniform(np.log(60.0), np.log(700.0)))
        slope, lapse = np.exp(rng.uniform(*np.log(SLOPE_RANGE))), rng.uniform(*LAPSE_RANGE)
        order, answered = draw_constant_levels(len(LEVELS), TRIALS[procedure], f"{seed} {number}"), []
        for _ in range(TRIALS[procedure]):
            level = select(procedure, model, answered, order)
            share = CHANCE + (1 - CHANCE - lapse) * (1 - np.exp(-((LEVELS[level] / threshold) ** slope)))
            answered.append((level, bool(rng.random() < share)))
        found = model.estimate(answered)
        errors += [] if found.threshold is None else [np.log(found.threshold / threshold)]
        holds.append((found.low or 0.0) <= threshold <= (found.high or np.inf))
    return Recovery(float(np.expm1(np.mean(errors))), float(np.mean(holds)))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
@pytest.mark.parametrize("procedure", TRIALS)
def test_thresholds_are_unbiased_and_their_intervals_cover(procedure, seed):
    recovery = judge(procedure, seed)
    assert recovery.are_met, recovery


@pytest.mark.parametrize("procedure", ["staircase", "constant"])
def test_the_check_finds_a_model_of_another_task(procedure):
    assert not judge(procedure, 0, chance=0.25).are_met


def estimate(answer, trials=40, procedure="quest-plus", levels=LEVELS):
    """Return the estimate of a participant that answers by a rule."""
    model, answered = ThresholdModel(levels, CHANCE), []
    order = draw_constant_levels(len(levels), trials, "estimate")
    for _ in range(trials):
        level = select(procedure, model, answered, order)
        answered.append((level, bool(answer(levels[level]))))
    return model.estimate(answered)


def draw_answers(seed, threshold, slope=3.0, lapse=0.02, exchanged=False):
    rng = np.random.default_rng(seed)

    def answer(level):
        share = CHANCE + (1 - CHANCE - lapse) * (1 - np.exp(-((level / threshold) ** slope)))
        return bool(rng.random() < share) != exchanged

    return answer


@pytest.mark.parametrize("procedure", ["quest-plus", "staircase", "constant"])
def test_a_threshold_outside_the_levels_is_a_bound_and_no_number(procedure):
    levels = tuple(np.geomspace(1000.0, 4000.0, 9))
    below = estimate(lambda level: True, procedure=procedure, levels=levels)
    assert (below.threshold, below.low, below.flags) == (None, None, ("all-correct",))
    assert 1000.0 <= below.high < 4000.0
    assert str(below).startswith("below 1")
    for seed in range(10):
        above = estimate(draw_answers(seed, 12_000.0), procedure=procedure, levels=levels)
        assert (above.threshold, above.high) == (None, None)
        assert above.low is None or 1000.0 <= above.low <= 4000.0
        assert {"guessing", "above-levels"} & set(above.flags)


def judge_flags(chance, trials, draw, count=60):
    """Return estimates of participants by constant stimuli, whose answers a function draws from level and rng."""
    found, model = [], ThresholdModel(LEVELS, chance)
    for number in range(count):
        rng, order = np.random.default_rng((7, number)), draw_constant_levels(len(LEVELS), trials, f"flags {number}")
        found.append(model.estimate([(level, bool(draw(LEVELS[level], rng))) for level in order]))
    return found


def respond(level, rng, guess, lapse=0.02):
    """A cumulative normal distribution over the logarithm of the level, which is not the model's function."""
    return rng.random() < guess + (1.0 - guess - lapse) * norm.cdf(np.log(level / 200.0) / 0.35)


@pytest.mark.parametrize("chance", [1 / 2, 1 / 3, None])
def test_answers_that_have_no_threshold_are_flagged_by_name(chance):
    guess = 0.1 if chance is None else chance
    cases = {
        "all-correct": lambda level, rng: True,
        "all-wrong": lambda level, rng: False,
        "exchanged-keys": lambda level, rng: not respond(level, rng, guess),
        "guessing": lambda level, rng: rng.random() < (0.5 if chance is None else chance),
        "lapses": lambda level, rng: respond(level, rng, guess, lapse=0.2),
        None: lambda level, rng: respond(level, rng, guess),
    }
    shares = {}
    for name, draw in cases.items():
        found = judge_flags(chance, 200, draw)
        shares[name] = np.mean([(name in each.flags) if name else not each.flags for each in found])
        if name in ("exchanged-keys", "guessing"):
            assert all(each.threshold is None for each in found if name in each.flags)
    assert shares["all-correct"] == shares["all-wrong"] == 1.0
    assert min(shares["exchanged-keys"], shares["guessing"], shares[None]) >= 0.93, shares
    assert shares["lapses"] >= 0.8, shares


def test_with_lapses_of_a_fifth_an_estimate_holds_the_threshold_or_is_flagged():
    found = [estimate(draw_answers(seed, 200.0, lapse=0.2), 60) for seed in range(100)]
    holds = [(each.low or 0.0) <= 200.0 <= (each.high or np.inf) for each in found]
    assert sum(holds) >= 80
    assert sum(not held and not each.flags for held, each in zip(holds, found, strict=True)) <= 15


@pytest.mark.parametrize("participants", [40, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("chance", [1 / 2, 1 / 3, None])
def test_intervals_cover_participants_of_another_function(chance, participants):
    """Cumulative normal functions over the logarithm; the share of the way to the asymptote at a threshold is 63 %."""
    rng, model, holds = np.random.default_rng(11), ThresholdModel(LEVELS, chance), []
    for number in range(participants):
        threshold, width = np.exp(rng.uniform(np.log(60.0), np.log(700.0))), rng.uniform(0.25, 0.6)
        guess, lapse = (rng.uniform(0.02, 0.2) if chance is None else chance), rng.uniform(*LAPSE_RANGE)
        answered = []
        for level in draw_constant_levels(len(LEVELS), 100, f"cover {number}"):
            way = norm.cdf(np.log(LEVELS[level] / threshold) / width + norm.ppf(1.0 - np.exp(-1.0)))
            answered.append((level, bool(rng.random() < guess + (1.0 - guess - lapse) * way)))
        found = model.estimate(answered)
        holds.append(found.threshold is not None and (found.low or 0.0) <= threshold <= (found.high or np.inf))
    covered = sum(holds)
    assert (0.92 * participants <= covered <= 0.98 * participants) if participants == 200 else covered >= 34, covered


def test_the_grid_is_bounded_and_the_next_level_does_not_depend_on_the_order_of_answers():
    model = ThresholdModel(LEVELS, CHANCE)
    assert model.correct.shape == (len(LEVELS), GRID_MAX)
    answered = [(12, True), (10, True), (8, False), (11, True)] * 50
    assert model.select_informative_level(answered) == model.select_informative_level(answered[::-1])
    assert np.isclose(model.compute_posterior(answered).sum(), 1.0)


def test_a_staircase_goes_down_after_two_correct_answers_and_up_after_an_error():
    answered, levels = [], []
    for is_correct in (True, True, False, True, True, True, False, True, True):
        levels.append(select_staircase_level(25, answered))
        answered.append((levels[-1], is_correct))
    assert levels == [24, 23, 22, 23, 23, 22, 22, 23, 23]
    assert select_staircase_level(25, answered) == 22
    assert select_staircase_level(25, [(24, False)]) == 24
    assert select_staircase_level(2, [(1, True), (0, True)]) == 0


@pytest.fixture(scope="module")
def display():
    return DisplayModel.from_config(load_config())


def run_detection(display, path, number, trials_before=None):
    """Run a session of the shipped study, in two parts if one ends before some trial."""
    study = load_study("detection").model_copy(update={"familiarisation": False, "pause_s": 0.2})
    observer = Observer(study, display, Participant())

    class EndsEarlyError(Exception):
        pass

    def end(record):
        if record["trial"] + 1 == trials_before:
            raise EndsEarlyError

    for on_trial in (end, lambda record: None):
        presenter = VirtualPresenter(display)
        respondent = SimulatedRespondent(observer, study.seed, number, presenter)
        with TrialLog(path, study, "01") as log:
            try:
                run_session(study, log, presenter, respondent, on_trial)
            except EndsEarlyError:
                continue
            records = [log.trials[index] for index in sorted(log.trials)]
    return study, list_answered(study, records)


def test_an_adaptive_session_goes_on_as_if_it_had_not_ended(display, tmp_path):
    _, whole = run_detection(display, tmp_path / "whole.jsonl", 1)
    _, parts = run_detection(display, tmp_path / "parts.jsonl", 1, trials_before=13)
    assert parts == whole
    assert len(whole) == 40


def test_the_shipped_study_finds_the_threshold_of_the_channel_model(display, tmp_path):
    presenter = VirtualPresenter(display)
    condition = {"side": "left", "power_mw": 1000.0}
    trial = ListedTrial("main", "main", False, condition)
    shown = presenter.present(build_stimulus(load_study("detection"), trial, condition, display.config))
    t_s = np.arange(0.0, shown.duration_s + 0.1, 1e-3)
    pulses = np.column_stack([shown.start_s, shown.width_s, shown.power_w, shown.pixel])
    displacement_m = display.build_cold_heat().simulate_displacement_m(pulses, int(shown.pixel[0]), t_s)
    threshold_mw = 1000.0 / max(compute_excitations(displacement_m, 1e-3))
    ratios = []
    for number in range(6):
        study, answered = run_detection(display, tmp_path / f"{number}.jsonl", number)
        found = build_threshold_model(study).estimate(answered)
        assert found.threshold is not None
        ratios.append(found.threshold / threshold_mw)
        assert found.low is None or found.low < threshold_mw
        assert found.high is None or found.high > threshold_mw
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, abs=0.25)  # three standard errors of six sessions
