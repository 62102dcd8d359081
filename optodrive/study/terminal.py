"""Answers of a person at a terminal: one line each, read aloud by a screen reader as any text."""

import time
from collections.abc import Callable

from optodrive.study.presenter import Presentation
from optodrive.study.session import RepeatReason, Respondent, Response
from optodrive.study.study_file import Study

REPEAT = "r"


class TerminalRespondent(Respondent):
    """A person who types answers.

    read: returns the line that answers a prompt, as `input` does; raises EOFError at the end
    """

    def __init__(self, study: Study, read: Callable[[str], str] = input) -> None:
        self._study, self._read = study, read

    def respond(self, shown: Presentation, trial: int, attempt: int) -> Response | RepeatReason:
        """Ask until there is a valid answer, and return it, or that the stimulus is to be repeated."""
        del attempt
        ended_s = shown.end_monotonic_s
        if ended_s is None:
            raise ValueError("a presentation in virtual time is not for a person")
        response = self._study.response
        choices = ", ".join(response.answers) if response.answers else "a number between 0 and 1"
        prompt = f"{trial + 1} of {self._study.trial_count}. {response.question} {choices}; {REPEAT}: again > "
        while (text := self._read(prompt).strip()) != REPEAT:
            answer = self._parse(text)
            if answer is not None:
                return Response(answer, round(time.monotonic() - ended_s, 6))
            prompt = f"{text!r} is no answer. {choices}; {REPEAT}: again > "
        return RepeatReason.REQUESTED

    def _parse(self, text: str) -> str | float | None:
        if self._study.response.answers:
            return text if text in self._study.response.answers else None
        try:
            value = float(text)
        except ValueError:
            return None
        return value if 0.0 < value < 1.0 else None
