"""Sessions: the trials of one participant in a study, from the first that does not count yet to the last."""

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from typing import Any, Protocol

import numpy as np

from optodrive.core.errors import RefusedError
from optodrive.study.observers import Observer
from optodrive.study.presenter import Presentation, Presenter
from optodrive.study.study_file import ProcedureSection, Study, Value
from optodrive.study.threshold import ThresholdModel, draw_constant_levels, select_staircase_level
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

    Every condition comes as often, `repetitions` times or, in a procedure, to within one. The order is recorded in the
    session's log, with the levels of constant stimuli.
    """
    seed, procedure = f"{study.seed} {participant}", study.procedure
    repetitions = ceil(study.trial_count / len(study.conditions))
    order = [dict(condition) for condition in study.conditions for _ in range(repetitions)]
    random.Random(seed).shuffle(order)
    order = order[: study.trial_count]
    if procedure is None or procedure.kind != "constant":
        return order
    levels = draw_constant_levels(len(procedure.levels), procedure.trials, f"{seed} levels")
    return [
        {**condition, procedure.parameter: procedure.levels[level]}
        for condition, level in zip(order, levels, strict=True)
    ]


def list_answered(procedure: ProcedureSection, records: Sequence[dict[str, Any]]) -> list[tuple[int, bool]]:
    """Return level and correctness of trials, in order."""
    return [
        (procedure.levels.index(record["condition"][procedure.parameter]), bool(record["is_correct"]))
        for record in records
    ]


def choose_condition(study: Study, log: TrialLog, trial: int) -> dict[str, Value]:
    """Return a trial's condition, with the level that the procedure chooses by the answers so far."""
    procedure, condition = study.procedure, log.order[trial]
    if procedure is None or procedure.kind == "constant":
        return condition
    answered = list_answered(procedure, [log.trials[index] for index in sorted(log.trials)])
    if procedure.kind == "staircase":
        level = select_staircase_level(len(procedure.levels), answered)
    else:
        level = build_threshold_model(study, procedure).select_informative_level(answered)
    return {**condition, procedure.parameter: procedure.levels[level]}


@lru_cache(maxsize=4)
def _build_model(levels: tuple[float, ...], chance: float) -> ThresholdModel:
    return ThresholdModel(levels, chance)


def build_threshold_model(study: Study, procedure: ProcedureSection) -> ThresholdModel:
    """Return the model of a procedure's threshold."""
    return _build_model(procedure.levels, 1.0 / len(study.response.answers))


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
        strongest = {} if study.procedure is None else {study.procedure.parameter: study.procedure.levels[-1]}
        shown = [_familiarise(study, presenter, {**condition, **strongest}) for condition in study.conditions]
        log.record_familiarisation(shown)
    while (trial := log.next_trial) is not None:
        on_trial(_run_trial(study, log, presenter, respondent, trial))
        presenter.wait(study.pause_s)


def _familiarise(study: Study, presenter: Presenter, condition: dict[str, Value]) -> dict[str, Any]:
    shown = presenter.present(study.stimulus.pattern, {**study.stimulus.parameters, **condition})
    presenter.wait(study.pause_s)
    return {"condition": condition, **shown.to_record()}


def _run_trial(study: Study, log: TrialLog, presenter: Presenter, respondent: Respondent, trial: int) -> dict[str, Any]:
    """Run one trial until it counts and return its record."""
    condition = choose_condition(study, log, trial)
    parameters = {**study.stimulus.parameters, **condition}
    for _ in range(ATTEMPTS_MAX):
        attempt, presentations, response = log.begin(trial, condition), [], None
        while response is None:
            shown = presenter.present(study.stimulus.pattern, parameters)
            if shown.fault is not None:
                break
            presentations.append(shown.to_record())
            response = respondent.respond(shown, trial, attempt)
        if response is None:
            log.spoil(str(shown.fault))
            continue
        correct = study.find_correct_answer(condition)
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
