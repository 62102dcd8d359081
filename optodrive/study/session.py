"""Sessions: the trials of one participant in a study, from the first that does not count yet to the last."""

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from optodrive.core.errors import RefusedError
from optodrive.study.observers import Observer
from optodrive.study.presenter import Presentation, Presenter
from optodrive.study.study_file import Study, Value
from optodrive.study.trial_log import TrialLog

ATTEMPTS_MAX = 5
"""Largest number of attempts at one trial within a run; a stimulus that always fails is a fault of the display."""
RESPONSE_MEDIAN_S, RESPONSE_SPREAD = 1.2, 0.35
"""Median response time of a simulated participant, s, and the standard deviation of its logarithm."""


@dataclass(frozen=True)
class Response:
    """A participant's answer and the time from the end of the stimulus to it."""

    answer: str | float
    response_time_s: float


class Respondent(Protocol):
    """Interface of who answers."""

    def respond(self, shown: Presentation, trial: int, attempt: int) -> Response | None:
        """Return the answer to a presentation, None to have it repeated."""


class SimulatedRespondent:
    """A simulated participant. Its answers follow from the study's seed, its number, the trial and the attempt."""

    def __init__(self, observer: Observer, seed: int, number: int, presenter: Presenter) -> None:
        self._observer, self._entropy, self._presenter = observer, (seed, number), presenter

    def respond(self, shown: Presentation, trial: int, attempt: int) -> Response:
        """Return the answer after the time that it takes."""
        rng = np.random.default_rng((*self._entropy, trial, attempt))
        answer = self._observer.answer(shown, rng)
        response_time_s = round(RESPONSE_MEDIAN_S * float(np.exp(RESPONSE_SPREAD * rng.standard_normal())), 6)
        self._presenter.wait(response_time_s)
        return Response(answer, response_time_s)


def draw_order(study: Study, participant: str) -> list[dict[str, Value]]:
    """Return the conditions of a participant's trials in an order drawn from the study's seed.

    Every condition comes `repetitions` times. The order is recorded in the session's log.
    """
    order = [dict(condition) for condition in study.conditions for _ in range(study.repetitions)]
    random.Random(f"{study.seed} {participant}").shuffle(order)
    return order


def run_session(
    study: Study,
    log: TrialLog,
    presenter: Presenter,
    respondent: Respondent,
    on_trial: Callable[[dict[str, Any]], None] = lambda record: None,
) -> None:
    """Run the trials that do not count yet. Every one that does is on the disk before the next begins.

    on_trial: gets the record of each trial. Raise an OptodriveError if the display cannot show a stimulus; the session
    can go on later.
    """
    if study.familiarisation and not log.is_familiarised:
        log.record_familiarisation([_familiarise(study, presenter, condition) for condition in study.conditions])
    while (trial := log.next_trial) is not None:
        on_trial(_run_trial(study, log, presenter, respondent, trial))
        presenter.wait(study.pause_s)


def _familiarise(study: Study, presenter: Presenter, condition: dict[str, Value]) -> dict[str, Any]:
    shown = presenter.present(study.stimulus.pattern, {**study.stimulus.parameters, **condition})
    presenter.wait(study.pause_s)
    return {"condition": condition, **shown.to_record()}


def _run_trial(study: Study, log: TrialLog, presenter: Presenter, respondent: Respondent, trial: int) -> dict[str, Any]:
    """Run one trial until it counts and return its record."""
    parameters = {**study.stimulus.parameters, **log.order[trial]}
    for _ in range(ATTEMPTS_MAX):
        attempt, presentations, response = log.begin(trial), [], None
        while response is None:
            shown = presenter.present(study.stimulus.pattern, parameters)
            if shown.fault is not None:
                break
            presentations.append(shown.to_record())
            response = respondent.respond(shown, trial, attempt)
        if response is None:
            log.spoil(str(shown.fault))
            continue
        correct = study.find_correct_answer(log.order[trial])
        return log.complete(
            {
                "requested": {"pattern": study.stimulus.pattern, "parameters": parameters},
                "presentations": presentations,
                "answer": response.answer,
                "is_correct": None if correct is None else response.answer == correct,
                "response_time_s": response.response_time_s,
            }
        )
    raise RefusedError(f"trial {trial + 1}: {ATTEMPTS_MAX} stimuli were not as requested, the last {shown.fault}")
