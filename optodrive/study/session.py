"""Sessions: the trials of one participant in a study, from the first that does not count yet to the last."""

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from math import ceil
from typing import Any

import numpy as np

from optodrive.core.errors import InputError, RefusedError
from optodrive.device.config import PixelLayout
from optodrive.study.matching import Comparison, MatchingModel
from optodrive.study.observers import Observer
from optodrive.study.presenter import Presentation, Presenter
from optodrive.study.study_file import MATCHING_ANSWERS, MatchingSection, ProcedureSection, Study, Value
from optodrive.study.threshold import ThresholdModel, draw_constant_levels, select_staircase_level
from optodrive.study.trial_log import TrialLog

ATTEMPTS_MAX = 5
"""Largest number of attempts at one trial within a run; a stimulus that always fails is a fault of the display."""
RESPONSE_MEDIAN_S, RESPONSE_SPREAD = 1.2, 0.35
"""Median response time of a simulated participant, s, and the standard deviation of its logarithm."""


@dataclass(frozen=True)
class Response:
    """A participant's answer and the time from the end of the stimulus to it.

    latency_s: the part of that time which the way of the answer may have taken; early_answers: number of answers before
    the end of the stimulus, which do not count; both None if the respondent cannot tell
    """

    answer: str | float
    response_time_s: float
    latency_s: float | None = None
    early_answers: int | None = None


class RepeatReason(StrEnum):
    """Why a stimulus is shown once more before its trial is answered."""

    REQUESTED = "requested"
    """The participant asked for it."""
    INTERRUPTED = "interrupted"
    """The participant's page was lost or replaced, or the participant took a break, before the answer."""


class Respondent:
    """Interface of who answers. One who is always ready inherits the methods that do nothing."""

    def wait_until_ready(self) -> None:
        """Wait until a stimulus may be shown."""

    def announce_example(self, number: int, count: int) -> None:
        """Tell that a stimulus without a question comes, `number` of `count`."""

    def announce(self, trial: int, attempt: int, presentation: int, condition: Mapping[str, Value]) -> None:
        """Tell that a trial's stimulus comes. presentation: its number within the attempt, from 1."""

    def withdraw(self, fault: str) -> None:
        """Tell that the announced stimulus was not as requested: there is no question about it."""

    def respond(self, shown: Presentation, trial: int, attempt: int) -> Response | RepeatReason:
        """Return the answer to a presentation, or why it is to be repeated."""
        raise NotImplementedError


class SimulatedRespondent(Respondent):
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


def list_comparisons(records: Sequence[dict[str, Any]]) -> list[tuple[Comparison, bool]]:
    """Return comparisons, and whether the second place was felt more strongly, of trials in order."""
    return [(Comparison(**record["condition"]), record["answer"] == MATCHING_ANSWERS[1]) for record in records]


def build_matching_model(matching: MatchingSection, layout: PixelLayout) -> MatchingModel:
    """Return the model of a matching on a display. Raise InputError for a display of one pixel."""
    if len(layout) < 2:
        raise InputError("matching", f"a display of {len(layout)} pixel", "at least two pixels to compare")
    return MatchingModel(layout.x_m, layout.y_m, matching.places, matching.intensity)


def choose_condition(study: Study, log: TrialLog, trial: int, matching: MatchingModel | None) -> dict[str, Value]:
    """Return a trial's condition, with the choice of a procedure or a matching by the answers so far."""
    procedure, condition = study.procedure, log.order[trial]
    if matching is not None:
        answers = list_comparisons([log.trials[index] for index in sorted(log.trials)])
        is_swapped = random.Random(f"{study.seed} {trial}").random() < 0.5
        return dict(matching.choose(answers, is_swapped)._asdict())
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
    matching: MatchingModel | None = None,
) -> None:
    """Run the trials that do not count yet. Every one that does is on the disk before the next begins.

    on_trial: gets the record of each trial; matching: of a study that has one, for its display. Raise an
    OptodriveError if the display cannot show a stimulus; the session can go on later.
    """
    if study.familiarisation and not log.is_familiarised:
        log.record_familiarisation(_familiarise(study, presenter, respondent))
    while (trial := log.next_trial) is not None:
        on_trial(_run_trial(study, log, presenter, respondent, trial, matching))
        presenter.wait(study.pause_s)


def _familiarise(study: Study, presenter: Presenter, respondent: Respondent) -> list[dict[str, Any]]:
    """Show each condition once and return the records of these presentations."""
    strongest = {} if study.procedure is None else {study.procedure.parameter: study.procedure.levels[-1]}
    records = []
    for number, factors in enumerate(study.conditions, start=1):
        condition = {**factors, **strongest}
        respondent.wait_until_ready()
        respondent.announce_example(number, len(study.conditions))
        shown = presenter.present(study.stimulus.pattern, {**study.stimulus.parameters, **condition})
        records.append({"condition": condition, **shown.to_record()})
        respondent.wait_until_ready()  # shows that the example is over
        presenter.wait(study.pause_s)
    return records


def _run_trial(
    study: Study,
    log: TrialLog,
    presenter: Presenter,
    respondent: Respondent,
    trial: int,
    matching: MatchingModel | None,
) -> dict[str, Any]:
    """Run one trial until it counts and return its record."""
    condition = choose_condition(study, log, trial, matching)
    parameters = {**study.stimulus.parameters, **condition}
    for _ in range(ATTEMPTS_MAX):
        respondent.wait_until_ready()  # before the trial is begun: it is not interrupted while nobody is there
        attempt = log.begin(trial, condition)
        presentations: list[dict[str, Any]] = []
        while True:
            respondent.announce(trial, attempt, len(presentations) + 1, condition)
            shown = presenter.present(study.stimulus.pattern, parameters)
            if shown.fault is not None:
                break
            response = respondent.respond(shown, trial, attempt)
            if isinstance(response, Response):
                presentations.append(shown.to_record())
                return log.complete(_build_record(study, condition, parameters, presentations, response))
            presentations.append({**shown.to_record(), "repeated": response.value})
            respondent.wait_until_ready()
        log.spoil(shown.fault)
        respondent.withdraw(shown.fault)
    raise RefusedError(f"trial {trial + 1}: {ATTEMPTS_MAX} stimuli were not as requested, the last {shown.fault}")


def _build_record(
    study: Study,
    condition: dict[str, Value],
    parameters: dict[str, Value],
    presentations: list[dict[str, Any]],
    response: Response,
) -> dict[str, Any]:
    correct = study.find_correct_answer(condition)
    return {
        "requested": {"pattern": study.stimulus.pattern, "parameters": parameters},
        "presentations": presentations,
        "answer": response.answer,
        "correct_answer": correct,
        "is_correct": None if correct is None else response.answer == correct,
        "response_time_s": response.response_time_s,
        "response_latency_s": response.latency_s,
        "early_answers": response.early_answers,
    }
