"""Answers of a person at a terminal: one line each, read aloud by a screen reader as any text."""

import re
import time
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import Any

from optodrive.study.presenter import Presentation
from optodrive.study.session import Follows, RepeatReason, Respondent, Response
from optodrive.study.study_file import Study
from optodrive.study.study_sections import QuestionSection, Value
from optodrive.study.trial_list import ListedTrial

REPEAT, REPEAT_WORD = "0", "again"
"""Answers that ask for the stimulus once more; the second one where an answer of the study begins with the first."""


def fill_text(texts: Mapping[str, str], key: str, **values: object) -> str:
    """Return a sentence of the page with its words in braces replaced."""
    return re.sub(r"\{(\w+)\}", lambda found: str(values[found[1]]), texts[key])


class TerminalRespondent(Respondent):
    """A person who types answers.

    read: returns the line that answers a prompt; raises EOFError at the end
    say: shows a text
    """

    def __init__(self, study: Study, read: Callable[[str], str], say: Callable[[str], None]) -> None:
        self._study, self._read, self._say, self._texts = study, read, say, study.page_texts
        self._number = ""
        clashes = any(answer.startswith(REPEAT) for answer in self._readable)
        self._repeat = REPEAT_WORD if clashes else REPEAT

    @property
    def _readable(self) -> tuple[str, ...]:
        return self._study.response.labels or self._study.response.answers

    def instruct(self, text: str | None) -> None:
        """Say instructions."""
        if text is not None:
            self._say(f"{text}\n")

    def take_break(self, text: str | None) -> None:
        """Wait for a line."""
        self.instruct(text)
        self._read(f"{self._texts['break']}: Enter > ")

    def announce_example(self, number: int, count: int) -> None:
        """Tell that a stimulus without a question comes."""
        self._say(fill_text(self._texts, "example_hint", number=number, count=count) + "\n")

    def announce(
        self, trial: int, attempt: int, presentation: int, listed: ListedTrial, condition: Mapping[str, Value]
    ) -> None:
        """Note the number of the trial."""
        before = 0 if self._study.practice is None else self._study.practice.count_max
        if listed.phase == "practice":
            self._number = fill_text(self._texts, "practice", number=trial + 1)
        else:
            self._number = f"{trial + 1 - before} / {self._study.trial_count}"

    def conclude(self, follows: Follows, is_correct: bool | None, correct: str | None) -> None:
        """Say whether the answer was correct."""
        del follows
        if is_correct is not None:
            label = dict(zip(self._study.response.answers, self._readable, strict=True)).get(str(correct), correct)
            self._say(fill_text(self._texts, "correct" if is_correct else "wrong", answer=label) + "\n")

    def fill_in(self, questions: Sequence[QuestionSection]) -> dict[str, Any]:
        """Ask each question until there is a valid answer."""
        return {question.name: self._ask(question) for question in questions}

    def _ask(self, question: QuestionSection) -> str | float:
        expected = ", ".join(question.answers)
        while True:
            text = self._read(f"{question.question} {expected} > ".replace("  ", " ")).strip()
            answer = _parse_number(text) if question.kind == "number" else _match(text, question.answers) or text
            if answer is not None and answer != "" and (not question.answers or answer in question.answers):
                return answer

    def respond(self, shown: Presentation, trial: int, attempt: int) -> Response | RepeatReason:
        """Ask until there is a valid answer, and return it, or that the stimulus is to be repeated."""
        del trial, attempt
        ended_s = shown.end_monotonic_s
        if ended_s is None:
            raise ValueError("a presentation in virtual time is not for a person")
        response = self._study.response
        kinds = {"magnitude": "a number between 0 and 1", "number": "a number above 0"}
        choices = ", ".join(self._readable) or kinds[response.kind]
        if response.again:
            choices += f"; {self._repeat}: {self._texts['again_key']}"
        prompt = f"{self._number}. {response.question} {choices} > "
        while (text := self._read(prompt).strip()) != self._repeat or not response.again:
            answer, time_s = self._parse(text), round(time.monotonic() - ended_s, 6)
            if response.max_s is not None and time_s > response.max_s:
                self._say(f"{self._texts['no_answer']}\n")
                return Response(None, None)
            if answer is not None:
                return Response(answer, time_s)
            prompt = f"{text!r} is no answer. {choices} > "
        return RepeatReason.REQUESTED

    def _parse(self, text: str) -> str | float | None:
        """Return the answer that a line states, or the only one that begins with it, None if there is none."""
        response = self._study.response
        if response.answers:
            label = _match(text, self._readable)
            return None if label is None else response.answers[self._readable.index(label)]
        value = _parse_number(text)
        return value if value is not None and 0.0 < value < response.number_max else None


def _match(text: str, answers: Sequence[str]) -> str | None:
    """Return the answer that a text is, or the only one that begins with it, None if there is none."""
    if text in answers:
        return text
    found = [answer for answer in answers if text and answer.casefold().startswith(text.casefold())]
    return found[0] if len(found) == 1 else None


def _parse_number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if isfinite(value) else None
