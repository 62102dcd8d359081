"""Sentences of the participant's page and of the terminal, which a study file may replace by a translation."""

import re

from optodrive.core.errors import suggest_nearest
from optodrive.core.toml_model import ConflictError

TEXTS: dict[str, str] = {
    "ready": "Ready?",
    "ready_hint": "Place your finger on the display. Press Start when you are ready.",
    "start": "Start",
    "break": "Break",
    "break_hint": "Place your finger on the display. Press Continue when you are ready.",
    "continue": "Continue",
    "take_break": "Take a break",
    "pause": "Pause",
    "pause_hint": "The study goes on when the operator continues.",
    "feel": "Feel",
    "example_hint": "Example {number} of {count}. No answer is needed.",
    "stimulus_hint": "Answer when the stimulus has ended.",
    "answer_now": "Answer now",
    "early_hint": "You answered before the stimulus had ended. Please answer now.",
    "wait": "Wait",
    "answered": "Your answer: {answer}.",
    "no_answer": "There was no answer in time.",
    "correct": "Correct.",
    "wrong": "Not correct. The correct answer: {answer}.",
    "next": "The next stimulus comes.",
    "done": "Finished",
    "done_hint": "Thank you. You may take your finger away.",
    "stopped": "Stopped",
    "stopped_hint": "Please wait for the operator.",
    "questions": "Questions",
    "questions_hint": "Please answer each question.",
    "send": "Send",
    "lost": "No connection",
    "lost_hint": "Trying again. If this lasts, please tell the operator.",
    "replaced": "Not in use",
    "replaced_hint": "This page was opened in another window, which is in use now. Reload to use this one.",
    "again": "Feel it again",
    "again_key": "again",
    "confirm": "Confirm",
    "no_answer_yet": "no answer yet",
    "scale": "Answer, from 0 to 1",
    "number": "Answer, a number above 0",
    "keys": "Answer with single keys",
    "trials": "{count} trials",
    "trial": "Trial {number} of {count}",
    "practice": "Practice trial {number}",
    "example": "Example {number} of {count}",
    "all_trials": "All {count} trials",
}
"""Every sentence by key. Words in braces stand for what the page fills in."""


def check_text(key: str, text: str) -> None:
    """Raise ConflictError for a text that the page has not, or that lacks or adds a word in braces."""
    place = f"texts.{key}"
    if key not in TEXTS:
        raise ConflictError(place, key, f"a text of the page, {suggest_nearest(key, list(TEXTS))}")
    words, found = (sorted(re.findall(r"\{\w*\}|[{}]", each)) for each in (TEXTS[key], text))
    if found != words:
        raise ConflictError(place, text, f"a text with {' and '.join(words) or 'no braces'}")
    if "\n" in text:
        raise ConflictError(place, text, "one line")


def fill_text(texts: dict[str, str], key: str, **values: object) -> str:
    """Return a text with its words in braces replaced."""
    return re.sub(r"\{(\w+)\}", lambda found: str(values[found[1]]), texts[key])
