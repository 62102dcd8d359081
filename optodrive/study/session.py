"""Sessions: the trials of one participant in a study, from the first that does not count yet to the last."""

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache, partial
from typing import Any, Literal

import numpy as np

from optodrive.core.errors import InputError, RefusedError
from optodrive.device.config import PixelLayout
from optodrive.study.matching import Comparison, MatchingModel
from optodrive.study.observers import Observer
from optodrive.study.presenter import Presentation, Presenter
from optodrive.study.study_file import MATCHING_ANSWERS, Study
from optodrive.study.study_sections import MatchingSection, QuestionSection, Value
from optodrive.study.threshold import DIFFERENCE_SLOPES, SLOPE_RANGE, ThresholdModel, select_staircase_level
from optodrive.study.trial_list import ListedTrial
from optodrive.study.trial_log import TrialLog
from optodrive.study.trial_stimulus import (
    IntervalTimes,
    TrialStimulus,
    build_stimulus,
    find_chosen_interval,
    find_correct_answer,
)

ATTEMPTS_MAX = 5
"""Largest number of attempts at one trial within a run; a stimulus that always fails is a fault of the display."""
RESPONSE_MEDIAN_S, RESPONSE_SPREAD = 1.2, 0.35
"""Median response time of a simulated participant, s, and the standard deviation of its logarithm."""


@dataclass(frozen=True)
class Response:
    """A participant's answer and the time from the end of the stimulus to it.

    Both None if there was none in time.
    latency_s: the part of that time which the way of the answer may have taken; early_answers: number of answers before
    the end of the stimulus, which do not count; both None if the respondent cannot tell
    """

    answer: str | float | None
    response_time_s: float | None
    latency_s: float | None = None
    early_answers: int | None = None


Follows = Literal["stimulus", "break", "end"]
"""What comes after a trial: its end is that of the last one."""


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

    def announce(
        self, trial: int, attempt: int, presentation: int, listed: ListedTrial, condition: Mapping[str, Value]
    ) -> None:
        """Tell that a trial's stimulus comes. presentation: its number within the attempt, from 1."""

    def conclude(self, follows: Follows, is_correct: bool | None, correct: str | None) -> None:
        """Tell the next step after a trial, and the feedback: whether the answer was correct, and the correct one."""

    def instruct(self, text: str | None) -> None:
        """Show instructions before the first stimulus of a run."""

    def take_break(self, text: str | None) -> None:
        """Offer a break, with the instructions of the next block."""

    def fill_in(self, questions: Sequence[QuestionSection]) -> dict[str, Any]:
        """Return the answers to a questionnaire, by the names of the questions."""
        raise NotImplementedError

    def show_parts(self, intervals: Sequence[IntervalTimes], begin_monotonic_s: float) -> None:
        """Tell when the intervals of the announced stimulus come: their times count from its beginning."""

    def withdraw(self, fault: str) -> None:
        """Tell that the announced stimulus was not as requested: there is no question about it."""

    def respond(self, shown: Presentation, trial: int, attempt: int) -> Response | RepeatReason:
        """Return the answer to a presentation, or why it is to be repeated."""
        raise NotImplementedError


class SimulatedRespondent(Respondent):
    """A simulated participant. Its answers follow from the study's seed, its number, the trial and the attempt.

    session: makes those of further sessions differ
    """

    def __init__(self, observer: Observer, seed: int, number: int, presenter: Presenter, session: int = 1) -> None:
        self._observer, self._presenter = observer, presenter
        self._entropy = (seed, number) if session == 1 else (seed, number, session)
        self._max_s = observer.study.response.max_s

    def respond(self, shown: Presentation, trial: int, attempt: int) -> Response:
        """Return the answer after the time that it takes."""
        rng = np.random.default_rng((*self._entropy, trial, attempt))
        answer = self._observer.answer(shown, rng)
        response_time_s = round(RESPONSE_MEDIAN_S * float(np.exp(RESPONSE_SPREAD * rng.standard_normal())), 6)
        if self._max_s is not None and response_time_s > self._max_s:
            self._presenter.wait(self._max_s)
            return Response(None, None)
        self._presenter.wait(response_time_s)
        return Response(answer, response_time_s)

    def fill_in(self, questions: Sequence[QuestionSection]) -> dict[str, Any]:
        """Answer with the first of the answers, 0 and `simulated`."""
        return {
            question.name: question.answers[0]
            if question.answers
            else 0.0
            if question.kind == "number"
            else "simulated"
            for question in questions
        }


def list_answered(study: Study, records: Sequence[dict[str, Any]]) -> list[tuple[int, bool]]:
    """Return level and correctness of the answered main trials of a study with levels, in order.

    Where an equality is sought, an answer that names the interval counts as correct: it lowers the level.
    """
    name = None if study.procedure is None else study.procedure.equal_interval
    levels, level_name = study.threshold_levels, str(study.threshold_of)
    return [
        (
            levels.index(float(record["condition"][level_name])),
            bool(record["is_correct"]) if name is None else record["chosen_interval"] == name,
        )
        for record in records
        if record["phase"] == "main" and not record["is_catch"] and record["answer"] is not None
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
    procedure, listed = study.procedure, log.order[trial]
    condition = dict(listed.condition)
    if matching is not None:
        answers = list_comparisons([log.trials[index] for index in sorted(log.trials)])
        is_swapped = random.Random(f"{study.seed} {trial}").random() < 0.5
        return dict(matching.choose(answers, is_swapped)._asdict())
    if procedure is None or procedure.parameter in condition:
        return condition
    records = [log.trials[index] for index in sorted(log.trials)]
    answered = list_answered(study, [record for record in records if record["block"] == listed.block])
    if procedure.kind == "staircase":
        level = select_staircase_level(len(procedure.levels), answered, procedure.down)
    else:
        level = build_threshold_model(study).select_informative_level(answered)
    return {**condition, procedure.parameter: procedure.levels[level]}


@lru_cache(maxsize=4)
def _build_model(levels: tuple[float, ...], chance: float, slope_range: tuple[float, float]) -> ThresholdModel:
    return ThresholdModel(levels, chance, slope_range)


def build_threshold_model(study: Study) -> ThresholdModel:
    """Return the model of a study's threshold."""
    slope_range = SLOPE_RANGE if study.response.level is None else DIFFERENCE_SLOPES
    return _build_model(study.threshold_levels, 1.0 / len(study.response.answers), slope_range)


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
    first = log.next_trial
    texts = (study.instructions, None if first is None else find_instructions(study, log.order[first]))
    respondent.instruct("\n\n".join(filter(None, texts)) or None)
    _ask(study, log, respondent, "before")
    if study.familiarisation and not log.is_familiarised:
        log.record_familiarisation(_familiarise(study, presenter, respondent))
    index, since_break = log.next_trial, 0
    while index is not None:
        listed = log.order[index]
        record = _run_trial(study, log, presenter, respondent, index, matching)
        on_trial(record)
        index, since_break = log.next_trial, since_break + 1
        following = None if index is None else log.order[index]
        is_other_block = following is not None and following.block != listed.block
        is_break = is_other_block or (following is not None and since_break == study.break_every)
        practice = study.practice if listed.phase == "practice" else None
        has_feedback = study.response.feedback if practice is None else practice.feedback
        feedback = (record["is_correct"], record["correct_answer"]) if has_feedback else (None, None)
        respondent.conclude("end" if following is None else "break" if is_break else "stimulus", *feedback)
        presenter.wait(study.pause_s)
        if following is not None and is_break:
            respondent.take_break(find_instructions(study, following) if is_other_block else None)
            since_break = 0
    _ask(study, log, respondent, "after")


def _ask(study: Study, log: TrialLog, respondent: Respondent, when: str) -> None:
    """Ask the questionnaire unless it is answered."""
    questions = [question for question in study.questions if question.when == when]
    if questions and when not in log.answers:
        log.record_answers(when, respondent.fill_in(questions))


def find_instructions(study: Study, listed: ListedTrial) -> str | None:
    """Return the text that is shown before the block of a trial."""
    if listed.phase == "practice":
        return None if study.practice is None else study.practice.instructions
    return next((block.instructions for block in study.block_list if block.name == listed.block), None)


def _familiarise(study: Study, presenter: Presenter, respondent: Respondent) -> list[dict[str, Any]]:
    """Show each condition once and return the records of these presentations."""
    strongest = {} if study.procedure is None else {study.procedure.parameter: study.procedure.levels[-1]}
    records = []
    for number, factors in enumerate(study.conditions, start=1):
        condition = {**factors, **strongest}
        respondent.wait_until_ready()
        respondent.announce_example(number, len(study.conditions))
        example = ListedTrial("examples", "practice", False, condition, study.interval_names)
        shown = presenter.present(build_stimulus(study, example, condition, presenter.config))
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
    listed, condition = log.order[trial], choose_condition(study, log, trial, matching)
    stimulus = build_stimulus(study, listed, condition, presenter.config)
    for _ in range(ATTEMPTS_MAX):
        respondent.wait_until_ready()  # before the trial is begun: it is not interrupted while nobody is there
        attempt = log.begin(trial, condition)
        presentations: list[dict[str, Any]] = []
        while True:
            respondent.announce(trial, attempt, len(presentations) + 1, listed, condition)
            shown = presenter.present(stimulus, partial(respondent.show_parts, stimulus.intervals))
            if shown.fault is not None:
                break
            response = respondent.respond(shown, trial, attempt)
            if isinstance(response, Response):
                presentations.append(shown.to_record())
                return log.complete(_build_record(study, listed, condition, stimulus, presentations, response))
            presentations.append({**shown.to_record(), "repeated": response.value})
            respondent.wait_until_ready()
        log.spoil(shown.fault)
        respondent.withdraw(shown.fault)
    raise RefusedError(f"trial {trial + 1}: {ATTEMPTS_MAX} stimuli were not as requested, the last {shown.fault}")


def _build_record(
    study: Study,
    listed: ListedTrial,
    condition: dict[str, Value],
    stimulus: TrialStimulus,
    presentations: list[dict[str, Any]],
    response: Response,
) -> dict[str, Any]:
    correct = find_correct_answer(study, listed, condition)
    return {
        "requested": stimulus.requested,
        "presentations": presentations,
        "answer": response.answer,
        "chosen_interval": find_chosen_interval(study, listed, response.answer),
        "correct_answer": correct,
        "is_correct": None if correct is None or response.answer is None else response.answer == correct,
        "response_time_s": response.response_time_s,
        "response_latency_s": response.latency_s,
        "early_answers": response.early_answers,
    }
