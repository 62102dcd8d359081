"""Thresholds of 200 simulated participants by each procedure: bias, coverage of the 95 % intervals, resumption."""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

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
        errors.append(np.log(found.threshold / threshold))
        holds.append(found.low <= threshold <= found.high)
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
    for _ in range(trials):
        level = select(procedure, model, answered, None)
        answered.append((level, bool(answer(levels[level]))))
    return model.estimate(answered)


def draw_answers(seed, threshold, slope=3.0, lapse=0.02, exchanged=False):
    rng = np.random.default_rng(seed)

    def answer(level):
        share = CHANCE + (1 - CHANCE - lapse) * (1 - np.exp(-((level / threshold) ** slope)))
        return bool(rng.random() < share) != exchanged

    return answer


@pytest.mark.parametrize("procedure", ["quest-plus", "staircase"])
def test_a_threshold_outside_the_levels_is_said_to_be_outside(procedure):
    levels = tuple(np.geomspace(1000.0, 4000.0, 9))
    below = estimate(lambda level: True, procedure=procedure, levels=levels)
    assert below.low < 500.0
    assert below.doubts == ("it may lie below the lowest level, 1000; the study does not measure it there",)
    for seed in range(10):
        above = estimate(draw_answers(seed, 12_000.0), procedure=procedure, levels=levels)
        assert above.high > 8_000.0
        assert any("above the highest level, 4000" in doubt for doubt in above.doubts)


def test_exchanged_keys_and_guesses_are_doubted_and_good_answers_are_not():
    doubts = [
        [estimate(draw_answers(seed, 200.0, **options), 60).doubts for seed in range(40)]
        for options in ({}, {"exchanged": True}, {"lapse": 0.15})
    ]
    good, exchanged, lapsing = doubts
    assert sum(bool(each) for each in good) <= 2
    assert all(any("exchanged keys?" in doubt for doubt in each) for each in exchanged)
    assert sum(bool(each) for each in lapsing) >= 10


def test_with_lapses_of_a_fifth_most_estimates_hold_the_threshold_or_are_doubted():
    found = [estimate(draw_answers(seed, 200.0, lapse=0.2), 60) for seed in range(100)]
    holds = [each.low <= 200.0 <= each.high for each in found]
    assert sum(holds) >= 80
    assert sum(not held and not each.doubts for held, each in zip(holds, found, strict=True)) <= 15


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
    return study, list_answered(study.procedure, records)


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
        found = build_threshold_model(study, study.procedure).estimate(answered)
        ratios.append(found.threshold / threshold_mw)
        assert found.low < threshold_mw < found.high
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, abs=0.25)  # three standard errors of six sessions
