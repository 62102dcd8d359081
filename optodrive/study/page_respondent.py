"""Answers of a person on a page in a browser, and the operator's view of the session.

Theory of operation. Two threads meet here: that of the session, which shows stimuli and waits for answers, and that of
the web server, which passes on the messages of pages. All state is behind one lock. Each change wakes the session by
the lock's condition, and the server by `on_change`; the server then sends each page its view, whole. A page has no
state of its own, so one that was reloaded shows the same as before.

- One participant's page is connected at a time, the newest. It is ready once its button was pressed, and no stimulus
  begins before. A page that is lost, replaced or has a break between the announcement of a stimulus and its answer
  interrupts the presentation: the stimulus is shown again once a page is ready.
- An answer names trial, attempt and presentation. It counts if it comes from the connected page, while that
  presentation is the announced one, and is the first after the end of the stimulus. Anything else that arrives changes
  nothing.
- One clock, CLOCK_MONOTONIC of this computer, times both ends: the end of the stimulus, which the daemon states on it,
  and the arrival of the answer's message. The session learns of the end later than the participant, so answers are
  kept from the announcement on; those that arrived before the end are counted as early and do not count as answers.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from optodrive.core.errors import OptodriveError, StoppedError
from optodrive.study.page_messages import (
    AgainMessage,
    AnswerMessage,
    Executed,
    FormMessage,
    OperatorView,
    ParticipantView,
    Phase,
    PresentationKey,
    ReadyMessage,
    TrialRow,
)
from optodrive.study.presenter import Presentation
from optodrive.study.session import Follows, RepeatReason, Respondent, Response
from optodrive.study.study_file import Study
from optodrive.study.study_sections import QuestionSection, Value
from optodrive.study.trial_list import ListedTrial, is_practice_over
from optodrive.study.trial_stimulus import IntervalTimes

INPUTS_MAX = 100
"""Answers that are kept from the announcement of a stimulus to its end. Further ones are dropped."""
ROWS_MAX = 50
"""Trials that the operator's page lists."""


@dataclass(frozen=True)
class _Input:
    """An answer, or None for a request to feel the stimulus again, when it arrived and its latency, s."""

    answer: str | float | None
    arrived_s: float
    latency_s: float | None


class PageRespondent(Respondent):
    """A participant in front of a page, and the operator beside.

    trials: the records that count already; on_change: called from both threads after each change, must return at once
    """

    def __init__(self, study: Study, participant: str, trials: Mapping[int, Mapping[str, Any]]) -> None:
        self.on_change: Callable[[], None] = lambda: None
        self._study, self._participant, self._texts = study, participant, study.page_texts
        counted = [record for record in trials.values() if record["phase"] == "main"]
        self._answered, self._correct = len(counted), sum(bool(record["is_correct"]) for record in counted)
        self._practised = [record for record in trials.values() if record["phase"] == "practice"]
        self._is_practice = not is_practice_over(study, self._practised)
        self._rows = [_build_row(trials[index]) for index in sorted(trials)[-ROWS_MAX:]]
        self._changed = threading.Condition()
        self._connection = 0
        self._is_present = self._is_ready = self._is_begun = self._is_paused = False
        self._example: tuple[int, int] | None = None
        self._announced: PresentationKey | None = None
        self._listed: ListedTrial | None = None
        self._condition: dict[str, Value] | None = None
        self._instructions = study.instructions
        self._questions: tuple[QuestionSection, ...] = ()
        self._forms: list[dict[str, Any]] = []
        self._feedback: tuple[bool | None, str | None] = (None, None)
        self._is_open = self._is_interrupted = False
        self._inputs: list[_Input] = []
        self._parts: list[tuple[float, float]] = []
        self._early_answers = 0
        self._noted: str | float | None = None
        self._has_missed = False
        self._follows: Follows | None = "stimulus"
        self._executed: Executed | None = None
        self._halt: str | None = None
        self._outcome: Phase | None = None
        self._notice = ""

    # The session's thread

    def wait_until_ready(self) -> None:
        """Wait until a participant's page is ready and the operator has not paused. Raise StoppedError after STOP."""
        with self._changed:
            self._example = self._announced = None
            self._notify()
            self._changed.wait_for(lambda: self._halt is not None or (self._is_ready and not self._is_paused))
            self._raise_if_halted()

    def announce_example(self, number: int, count: int) -> None:
        """Show that a stimulus without a question comes."""
        with self._changed:
            self._example = number, count
            self._notify()

    def instruct(self, text: str | None) -> None:
        """Show instructions until the participant is ready."""
        with self._changed:
            self._instructions = text
            self._notify()

    def take_break(self, text: str | None) -> None:
        """Let the participant rest, and wait for the button before the next stimulus."""
        with self._changed:
            self._instructions, self._noted, self._has_missed = text, None, False
            self._follows, self._feedback = "stimulus", (None, None)
            self._interrupt()

    def fill_in(self, questions: Sequence[QuestionSection]) -> dict[str, Any]:
        """Show a questionnaire until it is answered. Raise StoppedError after STOP."""
        with self._changed:
            self._questions = tuple(questions)
            self._forms.clear()
            self._notify()
            self._changed.wait_for(lambda: self._halt is not None or self._forms)
            self._raise_if_halted()
            self._questions = ()
            self._notify()
            return self._forms[0]

    def conclude(self, follows: Follows, is_correct: bool | None, correct: str | None) -> None:
        """Show the feedback to the last answer and the next step until the next stimulus."""
        with self._changed:
            self._follows, self._feedback = follows, (is_correct, correct)
            self._notify()

    def announce(
        self, trial: int, attempt: int, presentation: int, listed: ListedTrial, condition: Mapping[str, Value]
    ) -> None:
        """Show that a trial's stimulus comes, and keep answers to it from now on."""
        with self._changed:
            self._announced = PresentationKey(trial=trial, attempt=attempt, presentation=presentation)
            self._listed, self._is_practice = listed, listed.phase == "practice"
            self._has_missed, self._follows, self._feedback = False, None, (None, None)
            self._condition, self._executed, self._noted, self._example = dict(condition), None, None, None
            self._is_open, self._inputs, self._parts = False, [], []
            self._is_interrupted = not self._is_ready
            if presentation == 1:
                self._early_answers = 0
            self._notify()

    def show_parts(self, intervals: Sequence[IntervalTimes], begin_monotonic_s: float) -> None:
        """Mark the intervals of the announced stimulus on the page."""
        with self._changed:
            if len(intervals) > 1:
                self._parts = [
                    (begin_monotonic_s + start_s, begin_monotonic_s + end_s) for _, start_s, end_s in intervals
                ]
                self._notify()

    def withdraw(self, fault: str) -> None:
        """Drop the announced stimulus and its answers."""
        with self._changed:
            self._notice = f"trial {self._find_trial_number()} is repeated: {fault}"
            self._announced, self._follows = None, "stimulus"
            self._notify()

    def respond(self, shown: Presentation, trial: int, attempt: int) -> Response | RepeatReason:
        """Return the first answer after the end of the stimulus. Raise StoppedError after STOP."""
        del trial, attempt
        end_s = shown.end_monotonic_s
        if end_s is None:
            raise ValueError("a presentation in virtual time is not for a person")
        with self._changed:
            self._executed = Executed(
                pulses=len(shown.pixel), duration_s=shown.duration_s, onset_s=shown.onset_s, fault=shown.fault
            )
            early = [item for item in self._inputs if item.arrived_s < end_s]
            self._early_answers += sum(item.answer is not None for item in early)
            self._inputs = [item for item in self._inputs if item.arrived_s >= end_s]
            self._is_open = True
            self._notify()
            end_of_wait_s = None if (max_s := self._study.response.max_s) is None else end_s + max_s
            self._changed.wait_for(
                lambda: self._inputs or self._is_interrupted or self._halt is not None,
                None if end_of_wait_s is None else max(0.0, end_of_wait_s - time.monotonic()),
            )
            found = self._inputs[0] if self._inputs else None
            if end_of_wait_s is not None and found is not None and found.arrived_s > end_of_wait_s:
                found = None
            self._announced = None
            if found is not None and found.answer is not None:
                self._noted = found.answer
                self._notify()
                latency_s = None if found.latency_s is None else round(found.latency_s, 6)
                return Response(found.answer, round(found.arrived_s - end_s, 6), latency_s, self._early_answers)
            self._raise_if_halted()
            if found is None and not self._is_interrupted:
                self._has_missed = True
                self._notify()
                return Response(None, None, None, self._early_answers)
            self._notify()
            return RepeatReason.INTERRUPTED if found is None else RepeatReason.REQUESTED

    def record_trial(self, record: Mapping[str, Any]) -> None:
        """List a trial that counts."""
        with self._changed:
            if record["phase"] == "main":
                self._answered += 1
                self._correct += bool(record["is_correct"])
            else:
                self._practised.append(record)
                self._is_practice = not is_practice_over(self._study, self._practised)
            self._rows = [*self._rows, _build_row(record)][-ROWS_MAX:]
            self._notice = ""
            self._notify()

    def finish(self, error: BaseException | None) -> None:
        """Show that the run has ended, after the last trial or by an error."""
        with self._changed:
            self._announced, self._example = None, None
            self._outcome = "done" if error is None else "stopped"
            if isinstance(error, OptodriveError):
                self._notice = str(error)
            self._notify()

    # The web server's thread

    def join(self) -> int:
        """Connect a participant's page in place of the one before. Return the number of the connection."""
        with self._changed:
            self._connection += 1
            self._is_present = True
            self._interrupt()
            return self._connection

    def leave(self, connection: int) -> None:
        """Disconnect a participant's page, unless another has replaced it."""
        with self._changed:
            if connection == self._connection:
                self._is_present = False
                self._interrupt()

    def receive(
        self,
        connection: int,
        message: AnswerMessage | AgainMessage | ReadyMessage | FormMessage,
        arrived_s: float,
        latency_s: float | None,
    ) -> None:
        """Take a message of a participant's page that arrived at a time of CLOCK_MONOTONIC."""
        with self._changed:
            if connection != self._connection or self._outcome is not None:
                return
            if isinstance(message, ReadyMessage):
                if message.kind == "break":
                    self._interrupt()
                else:
                    self._is_ready = self._is_begun = True
                    self._notify()
            elif isinstance(message, FormMessage):
                if self._questions and all(_is_answered(question, message.answers) for question in self._questions):
                    self._forms.append({each.name: message.answers[each.name] for each in self._questions})
                    self._notify()
            elif self._accepts(message):
                answer = message.answer if isinstance(message, AnswerMessage) else None
                self._inputs.append(_Input(answer, arrived_s, latency_s))
                self._notify()

    def set_paused(self, is_paused: bool) -> None:
        """Let no further stimulus begin, or go on."""
        with self._changed:
            self._is_paused = is_paused
            self._notify()

    def halt(self, reason: str) -> None:
        """End the run of the session: its thread raises StoppedError."""
        with self._changed:
            self._halt = self._notice = reason
            self._notify()

    def build_participant_view(self, connection: int) -> ParticipantView | None:
        """Return the view of a participant's page, None if another page has replaced it."""
        study = self._study
        with self._changed:
            if connection != self._connection:
                return None
            now_s = time.monotonic()
            return ParticipantView(
                phase=self._find_phase(),
                title=study.title,
                language=study.language,
                texts=self._texts,
                instructions=self._instructions,
                question=study.response.question,
                kind=study.response.kind,
                answers=study.response.answers,
                labels=study.response.labels or study.response.answers,
                again=study.response.again,
                questions=self._questions,
                is_practice=self._is_practice,
                trial=self._find_trial_number(),
                trials=study.trial_count,
                has_missed=self._has_missed,
                follows=self._follows,
                parts=tuple((start_s - now_s, end_s - now_s) for start_s, end_s in self._parts),
                is_correct=self._feedback[0],
                correct=self._feedback[1],
                example=self._example,
                announced=None if self._is_interrupted else self._announced,
                is_early=self._is_open and self._early_answers > 0,
                answered=self._noted,
                is_begun=self._is_begun,
            )

    def build_operator_view(self) -> OperatorView:
        """Return the view of an operator's page."""
        study = self._study
        with self._changed:
            return OperatorView(
                phase=self._find_phase(),
                title=study.title,
                participant=self._participant,
                stimulus=study.stimulus.pattern or "frames",
                block=None if self._listed is None else self._listed.block,
                is_practice=self._is_practice,
                is_catch=self._listed is not None and self._listed.is_catch,
                trial=self._find_trial_number(),
                trials=study.trial_count,
                example=self._example,
                answered=self._answered,
                correct=self._correct if study.response.rules else None,
                is_present=self._is_present,
                is_ready=self._is_ready,
                is_paused=self._is_paused,
                announced=self._announced,
                condition=self._condition,
                executed=self._executed,
                rows=tuple(self._rows),
                notice=self._notice,
            )

    # With the lock held

    def _notify(self) -> None:
        self._changed.notify_all()
        self.on_change()

    def _interrupt(self) -> None:
        self._is_ready, self._is_interrupted = False, True
        self._notify()

    def _raise_if_halted(self) -> None:
        if self._halt is not None:
            raise StoppedError(self._halt)

    def _accepts(self, message: AnswerMessage | AgainMessage) -> bool:
        """Return whether an answer is about the announced presentation, and one that the study allows."""
        announced = self._announced
        if announced is None or self._is_interrupted or len(self._inputs) >= INPUTS_MAX:
            return False
        if (message.trial, message.attempt, message.presentation) != (
            announced.trial,
            announced.attempt,
            announced.presentation,
        ):
            return False
        if isinstance(message, AgainMessage):
            return self._study.response.again
        answers = self._study.response.answers
        if answers:
            return message.answer in answers
        return isinstance(message.answer, float) and 0.0 < message.answer < self._study.response.number_max

    def _find_phase(self) -> Phase:
        if self._outcome is not None:
            return self._outcome
        if self._questions:
            return "form"
        if not self._is_ready:
            return "start"
        if self._announced is not None and not self._is_interrupted:
            return "question" if self._is_open else "stimulus"
        if self._example is not None:
            return "example"
        return "pause" if self._is_paused else "rest"

    def _find_trial_number(self) -> int:
        """Return the number of the present or next trial within practice, or within the other trials."""
        before = 0 if self._study.practice is None else self._study.practice.count_max
        if self._announced is not None:
            return self._announced.trial + 1 - (0 if self._is_practice else before)
        if self._is_practice:
            return len(self._practised) + 1
        return min(self._answered + 1, self._study.trial_count)


def _is_answered(question: QuestionSection, answers: Mapping[str, str | float]) -> bool:
    """Return whether a questionnaire has a valid answer to a question."""
    answer = answers.get(question.name)
    if question.kind == "number":
        return isinstance(answer, float)
    return isinstance(answer, str) and (answer in question.answers if question.answers else bool(answer.strip()))


def _build_row(record: Mapping[str, Any]) -> TrialRow:
    shown = record["presentations"][-1]
    return TrialRow(
        trial=record["trial"] + 1,
        attempt=record["attempt"],
        presentations=len(record["presentations"]),
        is_practice=record["phase"] == "practice",
        is_catch=record["is_catch"],
        condition=record["condition"],
        answer=record["answer"],
        is_correct=record["is_correct"],
        response_time_s=record["response_time_s"],
        response_latency_s=record.get("response_latency_s"),
        early_answers=record.get("early_answers"),
        pulses=len(shown["executed"]["pixel"]),
        duration_s=shown["duration_s"],
    )
