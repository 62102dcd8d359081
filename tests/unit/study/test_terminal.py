"""Answers at a terminal: what a line may state, and what is said on which stream."""

import io

import numpy as np
import pytest

from optodrive.cli.study import _read_line
from optodrive.study.presenter import Presentation
from optodrive.study.session import RepeatReason
from optodrive.study.study_file import load_study
from optodrive.study.terminal import TerminalRespondent
from optodrive.study.trial_list import ListedTrial

SHOWN = Presentation(0.0, np.array([1]), np.zeros(1), np.ones(1), np.ones(1), None, onset_monotonic_s=0.0)


def respond(study, lines):
    """Return the answer to some lines, and the prompts."""
    prompts = []

    def read(prompt):
        prompts.append(prompt)
        return lines[len(prompts) - 1]

    response = TerminalRespondent(study, read, prompts.append).respond(SHOWN, 0, 1)
    return getattr(response, "answer", response), prompts


@pytest.mark.parametrize(
    ("study", "line", "answer"),
    [
        ("detection", "left", "left"),
        ("detection", " R ", "right"),
        ("detection", "0", RepeatReason.REQUESTED),
        ("experiment-6", "3-5", "3-5"),
        ("experiment-6", "4", "4-5"),
        ("experiment-4", "0.25", 0.25),
        ("experiment-4", "0", RepeatReason.REQUESTED),
    ],
)
def test_a_line_states_an_answer_or_asks_again(study, line, answer):
    assert respond(load_study(study), [line])[0] == answer


@pytest.mark.parametrize(
    ("study", "line"), [("detection", ""), ("detection", "x"), ("experiment-6", "2"), ("experiment-4", "1")]
)
def test_another_line_is_asked_for_again(study, line):
    found, (_, second) = respond(load_study(study), [line, "0"])
    assert found is RepeatReason.REQUESTED
    assert second.startswith(f"{line!r} is no answer.")


def test_an_answer_that_begins_like_the_key_has_a_word_for_again():
    study = load_study("detection")
    zero = study.model_copy(update={"response": study.response.model_copy(update={"answers": ("0", "1")})})
    assert respond(zero, ["0"])[0] == "0"
    found, (prompt,) = respond(zero, ["again"])
    assert found is RepeatReason.REQUESTED
    assert "again: again" in prompt


def test_examples_are_announced():
    said = []
    TerminalRespondent(load_study("detection"), said.append, said.append).announce_example(1, 2)
    assert said == ["Example 1 of 2. No answer is needed.\n"]


def test_prompts_leave_stdout_to_the_report(capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("left\n"))
    assert _read_line("On which side was it? ") == "left"
    output = capsys.readouterr()
    assert (output.out, output.err) == ("", "On which side was it? ")


def make_respondent(study, lines):
    said, left = [], iter(lines)

    def read(prompt):
        said.append(prompt)
        return next(left)

    return TerminalRespondent(study, read, said.append), said


def test_labels_are_read_and_answers_recorded():
    study = load_study("detection")
    response = study.response.model_copy(update={"labels": ("links", "rechts"), "again": False})
    german = study.model_copy(update={"response": response})
    found, (prompt,) = respond(german, ["r"])
    assert found == "right"
    assert "links, rechts > " in prompt
    found, prompts = respond(german, ["0", "l"])  # it cannot be felt again
    assert found == "left"
    assert prompts[1].startswith("'0' is no answer.")


@pytest.mark.parametrize(("line", "answer"), [("12.5", 12.5), ("1e3", 1000.0)])
def test_any_positive_number_is_an_answer_where_the_study_has_no_scale(line, answer):
    found, _ = respond(load_study("roughness"), ["0", "-1", "nan", "inf", line])
    assert found == answer


def test_an_answer_after_the_longest_time_does_not_count():
    study = load_study("detection")
    late = study.model_copy(update={"response": study.response.model_copy(update={"max_s": 1e-9})})
    found, prompts = respond(late, ["left"])
    assert found is None
    assert prompts[-1] == "There was no answer in time.\n"


def test_practice_feedback_breaks_and_questions_are_said():
    study = load_study("frequency-discrimination")
    respondent, said = make_respondent(study, ["", "x", "nan", "31", "l", "both", "first"])
    respondent.instruct(study.instructions)
    respondent.take_break(None)
    assert respondent.fill_in(study.questions[:2]) == {"age": 31.0, "hand": "left"}
    respondent.announce(0, 1, 1, ListedTrial("practice", "practice", False, {}), {})
    respondent.conclude("stimulus", False, "second")
    assert said[-1] == "Not correct. The correct answer: second.\n"
    assert "faster" in said[0]
    assert said[1] == "Break: Enter > "
    respondent.announce(24, 1, 1, ListedTrial("main", "main", False, {}), {})
    assert respondent._number == "1 / 46"
