"""Prediction of a study's accuracy by the model of a participant, before anybody takes part."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from optodrive.planning.display_model import DisplayModel
from optodrive.study.observers import Observer, Participant
from optodrive.study.presenter import Presentation, VirtualPresenter
from optodrive.study.study_file import Condition, Study


class PredictedAccuracy(NamedTuple):
    """Share of correct answers, and its standard error by the finite number of draws."""

    share: float
    standard_error: float


def present_conditions(study: Study, display: DisplayModel) -> list[tuple[Condition, Presentation]]:
    """Return every condition of a study as simulated boards execute it."""
    presenter = VirtualPresenter(display)
    shown: list[tuple[Condition, Presentation]] = []
    for condition in study.conditions:
        shown.append((condition, presenter.present(study.stimulus.pattern, {**study.stimulus.parameters, **condition})))
        presenter.wait(study.pause_s)
    presenter.close()
    return shown


def predict_accuracy(
    study: Study,
    display: DisplayModel,
    participant: Participant,
    shown: Sequence[tuple[Condition, Presentation]],
    draws: int,
    seed: int = 0,
) -> PredictedAccuracy:
    """Predict the share of correct answers of a study with a correct answer, from a number of draws per condition."""
    observer = Observer(study, display, Participant(participant.localisation_sd_m, lapse=0.0))
    rng = np.random.default_rng(seed)
    correct = [
        [observer.answer(presentation, rng) == study.find_correct_answer(condition) for _ in range(draws)]
        for condition, presentation in shown
    ]
    attentive, chance = float(np.mean(correct)), 1.0 / len(study.response.answers)
    share = (1.0 - participant.lapse) * attentive + participant.lapse * chance
    error = (1.0 - participant.lapse) * np.sqrt(attentive * (1.0 - attentive) / (draws * len(shown)))
    return PredictedAccuracy(share, float(error))
