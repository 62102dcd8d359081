"""The participant on a page: which answers count, when a session waits, and what each page is shown."""

import threading
import time

import numpy as np
import pytest

from optodrive.core.errors import StoppedError
from optodrive.study.page_messages import AgainMessage, AnswerMessage, ReadyMessage
from optodrive.study.page_respondent import INPUTS_MAX, PageRespondent
from optodrive.study.presenter import Presentation
from optodrive.study.session import RepeatReason, Response
from optodrive.study.study_file import load_study
from optodrive.study.trial_list import ListedTrial
from optodrive.study.trial_stimulus import IntervalTimes

CHOICE, MAGNITUDE = load_study("experiment-1"), load_study("experiment-4")
ONSET_S, DURATION_S = 100.0, 2.0
END_S = ONSET_S + DURATION_S
READY, BREAK = ReadyMessage(kind="ready"), ReadyMessage(kind="break")
CONDITION = {"direction": "left"}
LISTED = ListedTrial("main", "main", False, CONDITION)


def present():
    """Return a presentation of one pulse, which ends at END_S."""
    return Presentation(
        onset_s=7.0,
        pixel=np.array([3]),
        start_s=np.array([0.0]),
        width_s=np.array([DURATION_S]),
        power_w=np.array([1.0]),
        fault=None,
        onset_monotonic_s=ONSET_S,
    )


def say(answer, trial=0, attempt=1, presentation=1):
    return AnswerMessage(
        kind="answer", trial=trial, attempt=attempt, presentation=presentation, answer=answer, handled_s=0.01
    )


AGAIN = AgainMessage(kind="again", trial=0, attempt=1, presentation=1)


@pytest.fixture
def respondent():
    """A respondent with a page that is ready, at the stimulus of the first trial."""
    respondent = PageRespondent(CHOICE, "07", {})
    respondent.page = respondent.join()
    respondent.receive(respondent.page, READY, 90.0, None)
    respondent.announce(0, 1, 1, LISTED, CONDITION)
    return respondent


def start(function, *arguments):
    """Call a function in another thread. Return the list to which its result is appended, and the thread."""
    results = []
    thread = threading.Thread(target=lambda: results.append(function(*arguments)), daemon=True)
    thread.start()
    return results, thread


def test_the_time_is_from_the_end_of_the_stimulus_to_the_arrival(respondent):
    respondent.receive(respondent.page, say("left"), END_S + 0.75, 0.02)
    assert respondent.respond(present(), 0, 1) == Response("left", 0.75, 0.02, 0)


def test_an_answer_before_the_end_is_counted_as_early_and_the_first_after_it_counts(respondent):
    for answer, arrived_s in (("up", ONSET_S), ("down", END_S - 1e-6), ("left", END_S), ("right", END_S + 0.1)):
        respondent.receive(respondent.page, say(answer), arrived_s, None)
    assert respondent.respond(present(), 0, 1) == Response("left", 0.0, None, 2)


def test_early_answers_are_summed_over_the_presentations_of_an_attempt(respondent):
    respondent.receive(respondent.page, say("up"), ONSET_S, None)
    respondent.receive(respondent.page, AGAIN, END_S + 1.0, None)
    assert respondent.respond(present(), 0, 1) is RepeatReason.REQUESTED
    respondent.announce(0, 1, 2, LISTED, CONDITION)
    respondent.receive(respondent.page, say("up", presentation=2), ONSET_S, None)
    respondent.receive(respondent.page, say("left", presentation=2), END_S + 1.0, None)
    assert respondent.respond(present(), 0, 1).early_answers == 2
    respondent.announce(1, 1, 1, LISTED, CONDITION)
    respondent.receive(respondent.page, say("left", trial=1), END_S, None)
    assert respondent.respond(present(), 1, 1).early_answers == 0


@pytest.mark.parametrize(
    "wrong",
    [
        say("left", trial=1),
        say("left", attempt=2),
        say("left", presentation=2),
        say("sideways"),
        say(0.5),
        AgainMessage(kind="again", trial=0, attempt=2, presentation=1),
    ],
)
def test_an_answer_to_something_else_changes_nothing(respondent, wrong):
    respondent.receive(respondent.page, wrong, END_S + 0.1, None)
    respondent.receive(respondent.page, say("right"), END_S + 0.2, None)
    assert respondent.respond(present(), 0, 1) == Response("right", 0.2, None, 0)


@pytest.mark.parametrize("wrong", ["left", 0.0, 1.0, -1.0, 2.0])
def test_a_magnitude_lies_between_zero_and_one(wrong):
    respondent = PageRespondent(MAGNITUDE, "07", {})
    page = respondent.join()
    respondent.receive(page, READY, 90.0, None)
    respondent.announce(0, 1, 1, LISTED, {"level": 3})
    respondent.receive(page, say(wrong), END_S, None)
    respondent.receive(page, say(0.25), END_S + 1.0, None)
    assert respondent.respond(present(), 0, 1).answer == 0.25


def test_answers_that_are_kept_are_bounded(respondent):
    for _ in range(INPUTS_MAX + 50):
        respondent.receive(respondent.page, say("up"), ONSET_S, None)
    results, thread = start(respondent.respond, present(), 0, 1)
    while respondent.build_operator_view().phase != "question":
        pass
    respondent.receive(respondent.page, say("left"), END_S + 1.0, None)
    thread.join()
    assert results == [Response("left", 1.0, None, INPUTS_MAX)]


def test_an_answer_counts_once(respondent):
    respondent.receive(respondent.page, say("left"), END_S, None)
    respondent.respond(present(), 0, 1)
    respondent.receive(respondent.page, say("right"), END_S + 0.1, None)
    respondent.announce(1, 1, 1, LISTED, CONDITION)
    respondent.receive(respondent.page, say("right"), END_S + 0.2, None)
    respondent.receive(respondent.page, say("up", trial=1), END_S + 0.3, None)
    assert respondent.respond(present(), 1, 1).answer == "up"


def leave(respondent):
    respondent.leave(respondent.page)


def replace(respondent):
    respondent.join()


def take_break(respondent):
    respondent.receive(respondent.page, BREAK, END_S, None)


@pytest.mark.parametrize("interrupt", [leave, replace, take_break])
@pytest.mark.parametrize("is_open", [False, True])
def test_an_interrupted_presentation_is_repeated_and_its_answers_no_longer_count(respondent, interrupt, is_open):
    if is_open:
        results, thread = start(respondent.respond, present(), 0, 1)
        while respondent.build_operator_view().phase != "question":
            pass
    interrupt(respondent)
    respondent.receive(respondent.page, READY, END_S, None)
    respondent.receive(respondent.page, say("left"), END_S + 1.0, None)
    if not is_open:
        results, thread = start(respondent.respond, present(), 0, 1)
    thread.join()
    assert results == [RepeatReason.INTERRUPTED]


def test_an_answer_that_arrived_before_its_page_was_lost_counts(respondent):
    respondent.receive(respondent.page, say("left"), END_S + 0.5, None)
    respondent.leave(respondent.page)
    assert respondent.respond(present(), 0, 1).answer == "left"


def test_a_page_that_is_lost_between_readiness_and_stimulus_interrupts_it(respondent):
    respondent.leave(respondent.page)
    respondent.announce(0, 1, 2, LISTED, CONDITION)
    assert respondent.respond(present(), 0, 1) is RepeatReason.INTERRUPTED


def test_a_page_that_was_replaced_changes_nothing(respondent):
    newer = respondent.join()
    respondent.receive(newer, READY, 91.0, None)
    respondent.leave(respondent.page)
    view = respondent.build_operator_view()
    assert view.is_present
    assert view.is_ready
    respondent.receive(respondent.page, BREAK, 92.0, None)
    assert respondent.build_operator_view().is_ready
    assert respondent.build_participant_view(respondent.page) is None


def test_a_stimulus_waits_for_a_ready_page_and_for_the_operator():
    respondent = PageRespondent(CHOICE, "07", {})
    _, thread = start(respondent.wait_until_ready)
    page = respondent.join()
    assert respondent.build_participant_view(page).phase == "start"
    respondent.set_paused(True)
    respondent.receive(page, READY, 1.0, None)
    assert respondent.build_participant_view(page).phase == "pause"
    thread.join(0.05)
    assert thread.is_alive()
    respondent.set_paused(False)
    thread.join()


@pytest.mark.parametrize("is_open", [False, True])
def test_stop_ends_the_run(respondent, is_open):
    errors = []

    def wait():
        try:
            respondent.respond(present(), 0, 1) if is_open else respondent.wait_until_ready()
        except StoppedError as error:
            errors.append(str(error))

    respondent.leave(respondent.page) if not is_open else None
    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    respondent.halt("stopped by hand")
    thread.join()
    assert errors == ["stopped by hand"]


def test_a_stimulus_that_was_not_as_requested_has_no_question_and_the_operator_reads_why(respondent):
    respondent.receive(respondent.page, say("left"), END_S + 1.0, None)
    respondent.withdraw("3 of 4 pulses executed")
    assert respondent.build_participant_view(respondent.page).phase == "rest"
    assert respondent.build_operator_view().notice == "trial 1 is repeated: 3 of 4 pulses executed"
    respondent.announce(0, 2, 1, LISTED, CONDITION)
    respondent.receive(respondent.page, say("up", attempt=2), END_S + 1.0, None)
    assert respondent.respond(present(), 0, 2).answer == "up"


def test_the_parts_of_a_stimulus_are_marked_until_the_next_one(respondent):
    now_s = time.monotonic()
    respondent.show_parts([IntervalTimes("", 0.0, 0.5)], now_s)
    assert respondent.build_participant_view(respondent.page).parts == ()
    respondent.show_parts([IntervalTimes("a", 0.0, 0.5), IntervalTimes("b", 1.0, 1.5)], now_s)
    (first, first_end), (second, second_end) = respondent.build_participant_view(respondent.page).parts
    assert first <= 0.0
    assert (first_end - first, second - first, second_end - first) == pytest.approx((0.5, 1.0, 1.5))
    respondent.announce(1, 1, 1, LISTED, CONDITION)
    assert respondent.build_participant_view(respondent.page).parts == ()


def test_the_participant_is_never_shown_a_condition(respondent):
    condition = {"direction": "a direction that no answer names"}
    respondent.announce(0, 1, 1, LISTED, condition)
    view = respondent.build_participant_view(respondent.page).model_dump_json()
    assert "condition" not in view
    assert condition["direction"] not in view
    assert respondent.build_operator_view().condition == condition


def test_every_phase_has_its_views():
    respondent = PageRespondent(CHOICE, "07", {})
    phases = []
    page = respondent.join()

    def note():
        phase = respondent.build_participant_view(page).phase
        assert respondent.build_operator_view().phase == phase
        phases.append(phase)

    note()
    respondent.receive(page, READY, 1.0, None)
    respondent.announce_example(1, 4)
    note()
    respondent.announce(0, 1, 1, LISTED, CONDITION)
    note()
    results, thread = start(respondent.respond, present(), 0, 1)
    while respondent.build_operator_view().phase != "question":
        pass
    note()
    respondent.receive(page, say("left"), END_S + 1.0, None)
    thread.join()
    note()
    respondent.set_paused(True)
    note()
    respondent.finish(None)
    note()
    assert phases == ["start", "example", "stimulus", "question", "rest", "pause", "done"]
    assert results[0].answer == "left"
