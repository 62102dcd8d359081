"""Answers of a person at a terminal: one line each, read aloud by a screen reader as any text."""

import time
from collections.abc import Callable

from optodrive.study.presenter import Presentation
from optodrive.study.session import RepeatReason, Respondent, Response
from optodrive.study.study_file import Study

REPEAT, REPEAT_WORD = "0", "again"
"""Answers that ask for the stimulus once more; the second one where an answer of the study begins with the first."""


class TerminalRespondent(Respondent):
    """A person who types answers.

    read: returns the line that answers a prompt; raises EOFError at the end
    say: shows a text
    """

    def __init__(self, study: Study, read: Callable[[str], str], say: Callable[[str], None]) -> None:
        self._study, self._read, self._say = study, read, say
        clashes = any(answer.startswith(REPEAT) for answer in study.response.answers)
        self._repeat = REPEAT_WORD if clashes else REPEAT

    def announce_example(self, number: int, count: int) -> None:
        """Tell that a stimulus without a question comes."""
        self._say(f"Example {number} of {count}. No answer is needed.\n")

    def respond(self, shown: Presentation, trial: int, attempt: int) -> Response | RepeatReason:
        """Ask until there is a valid answer, and return it, or that the stimulus is to be repeated."""
        del attempt
        ended_s = shown.end_monotonic_s
        if ended_s is None:
            raise ValueError("a presentation in virtual time is not for a person")
        response = self._study.response
        choices = ", ".join(response.answers) if response.answers else "a number between 0 and 1"
        prompt = f"{trial + 1} of {self._study.trial_count}. {response.question} {choices}; {self._repeat}: again > "
        while (text := self._read(prompt).strip()) != self._repeat:
            answer = self._parse(text)
            if answer is not None:
                return Response(answer, round(time.monotonic() - ended_s, 6))
            prompt = f"{text!r} is no answer. {choices}; {self._repeat}: again > "
        return RepeatReason.REQUESTED

    def _parse(self, text: str) -> str | float | None:
        """Return the answer that a line states, or the only one that begins with it, None if there is none."""
        answers = self._study.response.answers
        if answers:
            if text in answers:
                return text
            found = [answer for answer in answers if text and answer.casefold().startswith(text.casefold())]
            return found[0] if len(found) == 1 else None
        try:
            value = float(text)
        except ValueError:
            return None
        return value if 0.0 < value < 1.0 else None
