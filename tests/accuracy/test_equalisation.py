"""Equalisation of a simulated participant whose sensitivity varies over the display by a map that nothing else knows.

The maps are of other families than the one that `optodrive study` rehearses with, and their seeds served for nothing
else.
"""

import numpy as np
import pytest

from displays import DISPLAYS
from felt_intensity import STEP_S, feel
from optodrive.device.sensitivity_map import replace_sensitivity_map
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.stimuli.sequence_file import parse_sequence
from optodrive.study.matching import MatchingModel
from optodrive.study.observers import Observer, Participant
from optodrive.study.presenter import Presentation
from optodrive.study.results import write_sensitivity
from optodrive.study.session import SimulatedRespondent, build_matching_model, run_session
from optodrive.study.study_file import load_study
from optodrive.study.trial_log import TrialLog

DISPLAY = DISPLAYS["display-437"]
STUDY = load_study("equalisation")
TRIALS = 1000
RESIDUAL_MAX = 0.05
INTENSITY = 8.0
SENSITIVITY_RATIO = 2.0
SEEDS = {"slope": 3101, "bowl": 3102, "two bumps": 3103, "wave": 3104}
RESIDUAL_BY_TRIALS = {
    0.2: {100: 0.081, 200: 0.060, 300: 0.048, 500: 0.037, 700: 0.030, 1000: 0.026},
    0.4: {300: 0.084, 1000: 0.047},
}
"""Mean of twelve participants by Weber fraction and trials, as docs/how-to/find-thresholds.md states it."""


def draw_hidden(kind, seed):
    """Return the sensitivity of every pixel, whose largest is twice the smallest."""
    rng, layout = np.random.default_rng(seed), DISPLAY.layout
    place = np.column_stack([layout.x_m, layout.y_m]) / np.abs(layout.x_m).max()
    angle = rng.uniform(0.0, 2.0 * np.pi)
    along = place @ (np.cos(angle), np.sin(angle))
    if kind == "slope":
        height = along
    elif kind == "bowl":
        height = np.sum((place - rng.uniform(-0.4, 0.4, 2)) ** 2, axis=1)
    elif kind == "two bumps":
        middles, signs = rng.uniform(-0.7, 0.7, (2, 2)), rng.choice([-1.0, 1.0], 2) * (1.0, 0.7)
        height = sum(
            sign * np.exp(-np.sum((place - middle) ** 2, axis=1) / 0.6)
            for sign, middle in zip(signs, middles, strict=True)
        )
    else:
        height = np.sin(np.pi * along + rng.uniform(0.0, 2.0 * np.pi))
    logarithm = np.log(SENSITIVITY_RATIO) * (height - height.min()) / np.ptp(height)
    return np.exp(logarithm - logarithm.mean())


class PlannedPresenter:
    """Presents the pulses that are planned on a cold display."""

    config = DISPLAY.config

    def present(self, stimulus, on_begin):
        plan = check_feasibility(DISPLAY, stimulus.sequence, *DISPLAY.build_cold_state(), policy="refuse")[0].plan
        return Presentation(0.0, plan.pixel, plan.start_s - plan.start_s[0], plan.width_s, plan.power_w, None)

    def wait(self, duration_s):
        pass


def compute_variation(config, truth):
    """Return standard deviation over mean of what is felt where every pixel is asked for INTENSITY."""
    frame = {"show_at_s": 0.0, "duration_s": 60.0, "intensity": [INTENSITY] * len(truth)}
    target_m = parse_sequence({"frames": [frame]}, config, "f").frames[0].target_m
    cold, drive, felt = DISPLAY.build_cold_heat(), DISPLAY.scan_head.drive, []
    for pixel, height_m in enumerate(target_m.tolist()):
        periods, duty = cold.solve_pulse(pixel, 0.0, height_m, drive)
        pulse = np.array([[0.0, periods * drive.period_s, duty * drive.max_power_w, pixel]])
        t_s = np.arange(0.0, pulse[0, 1] + 0.1, STEP_S)
        felt.append(feel(cold.simulate_displacement_m(pulse, pixel, t_s), truth[pixel]))
    return np.std(felt) / np.mean(felt)


def match(truth, seed, folder):
    """Run the study with a participant of the given sensitivity and return the configuration with its map."""
    observer = Observer(STUDY, DISPLAY, Participant(), truth)
    presenter, model = PlannedPresenter(), build_matching_model(STUDY.matching, DISPLAY.layout)
    with TrialLog(folder / "trials.jsonl", STUDY, "p1") as log:
        log.begin_run("planned pulses")
        respondent = SimulatedRespondent(observer, seed, 1, presenter)
        run_session(STUDY, log, presenter, respondent, matching=model)
        records = [log.trials[index] for index in sorted(log.trials)]
    assert len(records) == TRIALS
    path, _ = write_sensitivity(folder, STUDY, STUDY.matching, "p1", records, DISPLAY.config)
    return replace_sensitivity_map(DISPLAY.config, path)


@pytest.mark.parametrize("kind", SEEDS)
def test_the_same_intensity_is_felt_alike_everywhere_after_matching(kind, tmp_path):
    truth = draw_hidden(kind, SEEDS[kind])
    assert compute_variation(DISPLAY.config, truth) > 0.15
    residual = compute_variation(match(truth, SEEDS[kind], tmp_path), truth)
    assert residual <= RESIDUAL_MAX


def compute_residuals(seed, kind, weber_fraction, by_trials):
    """Return the residual variation by trials of a participant who is asked without a display.

    Also the share of the pixels whose sensitivity lies in its 95 % interval after all trials, and the variation before.
    """
    truth, rng = draw_hidden(kind, seed), np.random.default_rng(seed)
    model, answers, residuals = MatchingModel(DISPLAY.layout.x_m, DISPLAY.layout.y_m, 60, 6.0), [], {}
    unequalised = (1.5 + INTENSITY) * truth - 1.5
    before = float(unequalised.std() / unequalised.mean())
    for trial in range(1, max(by_trials) + 1):
        shown = model.choose(answers, bool(rng.integers(2)))
        felt = [
            np.log(truth[pixel] * (1.5 + intensity)) + weber_fraction * rng.standard_normal()
            for pixel, intensity in ((shown.first, shown.first_intensity), (shown.second, shown.second_intensity))
        ]
        is_guess = rng.random() < Participant().lapse
        answers.append((shown, bool(rng.integers(2)) if is_guess else bool(felt[1] > felt[0])))
        if trial in by_trials:
            found = model.estimate(answers)
            sensation = (1.5 + INTENSITY) * truth / found.sensitivity - 1.5
            residuals[trial] = float(sensation.std() / sensation.mean())
    is_within = np.abs(np.log(truth / found.sensitivity)) < 1.96 * found.sigma / found.sensitivity
    return residuals, float(is_within.mean()), before


@pytest.mark.slow
@pytest.mark.parametrize("weber_fraction", RESIDUAL_BY_TRIALS)
def test_the_documented_residual_variation_by_number_of_trials(weber_fraction):
    by_trials = RESIDUAL_BY_TRIALS[weber_fraction]
    kinds = list(SEEDS)
    residuals, shares, before = zip(
        *(compute_residuals(seed, kinds[seed % len(kinds)], weber_fraction, by_trials) for seed in range(3201, 3213)),
        strict=True,
    )
    assert min(before) > 0.15
    assert np.mean(shares) > 0.9
    means = {trials: np.mean([each[trials] for each in residuals]) for trials in by_trials}
    for trials, mean in means.items():
        assert mean == pytest.approx(by_trials[trials], abs=0.004)
