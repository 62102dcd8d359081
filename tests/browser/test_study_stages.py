"""The participant's page over a whole session: questionnaire, examples, practice with feedback, blocks, and its end."""

import csv
import json

import pytest
from playwright.sync_api import expect

from optodrive.study.study_file import load_study
from study_page_rig import PageStudy
from study_rig import find_defects, read_records
from study_visit import StudyVisit
from test_study_participant import check_with_axe
from window import PHONE

STUDY = """
format = "optodrive-study"
version = 2
name = "stages"
title = "Stages"
seed = 3
pause_s = 0.6
familiarisation = true
instructions = "Two vibrations come.\\n\\nOne is faster."

[stimulus]
pattern = "vibration"
parameters = {{ height_um = 80.0, seconds = 0.2 }}
gap_s = 0.2

[[intervals]]
name = "slow"
parameters = {{ rate_hz = 20.0 }}

[[intervals]]
name = "fast"

[factors]
rate_hz = [40.0]

[order]
intervals = "fixed"

[[blocks]]
name = "one"

[[blocks]]
name = "two"
instructions = "The second half."

[practice]
trials = 1
criterion = 1.0
trials_max = 3

[response]
kind = "choice"
question = "Which was faster?"
answers = ["first", "second"]
correct_interval = "fast"
chance_level = 0.5
{more}

[[questions]]
name = "age"
question = "How old are you?"
kind = "number"

[[questions]]
name = "hand"
question = "Which hand do you write with?"
kind = "choice"
answers = ["left", "right", "both"]

[[questions]]
name = "strategy"
question = "How did you decide?"
when = "after"
"""
HISTORY = """(() => {
    window.history_seen = [];
    const note = () => {
        const find = (id) => document.getElementById(id)?.textContent ?? "";
        const seen = [document.body.dataset.phase, find("progress-text"), find("state"), find("hint")];
        if (JSON.stringify(seen) !== JSON.stringify(window.history_seen.at(-1))) window.history_seen.push(seen);
    };
    addEventListener("DOMContentLoaded", () => new MutationObserver(note).observe(document.body, {
        subtree: true, childList: true, characterData: true, attributes: true,
    }));
})()"""
READY = "Place your finger on the display. Press Start when you are ready."
GO_ON = "Place your finger on the display. Press Continue when you are ready."
ANSWER = "Answer when the stimulus has ended."


@pytest.fixture
def make_study(bench, tmp_path):
    """Return a function that starts the study on the armed display."""
    bench.daemon.arm()
    studies = []

    def make(text):
        path = tmp_path / "stages.toml"
        path.write_text(text)
        studies.append(PageStudy(tmp_path, bench.daemon, path))
        assert studies[-1].read_urls(), studies[-1].said
        return studies[-1]

    yield make
    for study in studies:
        study.kill()


def fill_in_before(visit):
    visit.wait_for("form")
    visit.page.get_by_label("How old are you?").fill("31")
    visit.page.get_by_label("left").check()
    visit.page.locator("#send").press("Enter")
    visit.wait_for_other("form")


def test_every_sentence_is_true_from_the_first_trial_to_the_last(make_study, browser, tmp_path, axe):
    study = make_study(STUDY.format(more=""))
    visit = StudyVisit(browser, "about:blank")
    visit.context.add_init_script(HISTORY)
    page = visit.page
    page.goto(study.urls["participant"])
    visit.wait_for("form")
    check_with_axe(visit, axe)
    page.locator("#send").click()  # nothing is filled in: the browser asks for it, and nothing is sent
    assert page.evaluate("document.getElementById('form').checkValidity()") is False
    fill_in_before(visit)
    visit.wait_for("start")
    expect(page.locator("#instructions p")).to_have_text(["Two vibrations come.", "One is faster."])
    check_with_axe(visit, axe)
    answers = iter(("f", "s", "s", "s"))
    while (phase := visit.wait_for("start", "question", "form")) != "form":
        if phase == "start":
            page.locator("#begin").press("Enter")
        else:
            page.keyboard.press(next(answers))
        visit.wait_for_other(phase)
    page.get_by_label("How did you decide?").fill("by the buzz")
    page.keyboard.press("Enter")
    visit.wait_for("done")
    assert study.end() == 0
    seen = [tuple(each) for each in page.evaluate("window.history_seen") if each[0] != "connect"]
    # A late page may miss the mark of an interval.
    assert [each for each in seen if each[0] == "stimulus" and each[2] not in ("Feel", "Part 1", "Part 2")] == []
    unmarked = [each for each in seen if each[0] != "rest" and not each[2].startswith("Part ")]
    assert [each for k, each in enumerate(unmarked) if k == 0 or each != unmarked[k - 1]] == [
        ("form", "2 trials", "Questions", "Please answer each question."),
        ("start", "2 trials", "Ready?", READY),
        ("example", "Example 1 of 1", "Feel", "Example 1 of 1. No answer is needed."),
        *list_trial("Practice trial 1"),
        *list_trial("Practice trial 2"),
        ("start", "Trial 1 of 2", "Break", GO_ON),
        *list_trial("Trial 1 of 2"),
        ("start", "Trial 2 of 2", "Break", GO_ON),
        *list_trial("Trial 2 of 2"),
        ("form", "2 trials", "Questions", "Please answer each question."),
        ("done", "All 2 trials", "Finished", "Thank you. You may take your finger away."),
    ]
    # Of the states between, the page gets the newest one alone; those that last for a pause are all seen. An answer may
    # be seen before it is known what follows, as at the end: each state counts where it was seen last.
    between = list(dict.fromkeys(each[1:] for each in reversed(seen) if each[0] == "rest"))[::-1]
    wrong = "Your answer: first. Not correct. The correct answer: second. The next stimulus comes."
    lasting = [
        ("Practice trial 1", "Wait", "The next stimulus comes."),
        ("Practice trial 2", "Wait", wrong),
        ("Trial 1 of 2", "Wait", "Your answer: second. Correct. A break comes."),
        ("Trial 2 of 2", "Wait", "Your answer: second. A break comes."),
        ("Trial 2 of 2", "Wait", "Your answer: second."),
    ]
    assert [each for each in between if each in lasting] == lasting
    short = {("Practice trial 1", "Your answer: first."), ("Practice trial 2", "Your answer: first.")}
    short |= {(f"{which} 2", "Your answer: second.") for which in ("Practice trial", "Trial 1 of", "Trial 2 of")}
    short |= {(f"Trial {number} of 2", "The next stimulus comes.") for number in (1, 2)}
    assert {(progress, hint) for progress, _, hint in between if (progress, "Wait", hint) not in lasting} <= short
    assert visit.errors == []
    visit.context.close()
    check_dataset(tmp_path / "data")


def list_trial(progress):
    return [("stimulus", progress, "Feel", ANSWER), ("question", progress, "Answer now", "")]


def check_dataset(folder):
    records = read_records(next(folder.rglob("*_trials.jsonl")))
    assert find_defects(records) == []
    with next(folder.glob("sub-07/beh/*.tsv")).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    assert [(row["block"], row["answer"], row["is_correct"]) for row in rows] == [
        ("practice", "first", "0"),
        ("practice", "second", "1"),
        ("one", "second", "1"),
        ("two", "second", "1"),
    ]
    assert {row["exclusion"] for row in rows} == {"n/a"}
    form = (folder / "phenotype/stages_questionnaire.tsv").read_text()
    assert form == "participant_id\tage\thand\tstrategy\nsub-07\t31.0\tleft\tby the buzz\n"


def test_a_translated_page_by_touch_on_a_phone_without_an_answer_in_time(make_study, browser, tmp_path):
    texts = load_study("pattern-identification").texts
    german = 'labels = ["erste", "zweite"]\nmax_s = 1.5\nagain = false\n'
    written = STUDY.format(more=german).replace("[practice]\ntrials = 1\ncriterion = 1.0\ntrials_max = 3\n", "")
    written = written.replace("seed = 3", 'seed = 3\nlanguage = "de"')
    written += "\n[texts]\n" + "".join(f"{key} = {json.dumps(text)}\n" for key, text in texts.items())
    study = make_study(written)
    visit = StudyVisit(browser, study.urls["participant"], viewport=PHONE, has_touch=True, is_mobile=True)
    page = visit.page
    fill_in_before(visit)
    visit.wait_for("start")
    assert visit.read_state() == (texts["ready"], texts["ready_hint"])
    assert page.evaluate("document.documentElement.lang") == "de"
    page.locator("#begin").tap()
    visit.wait_for("question")
    assert visit.read_state()[0] == "Jetzt antworten"
    assert not page.locator("#again").is_visible()
    assert page.locator("#answers button").first.inner_text().startswith("erste")
    visit.wait_for("rest")
    expect(page.locator("#hint")).to_contain_text("Es kam keine Antwort in der Zeit.")
    visit.wait_for("start")
    page.locator("#begin").tap()
    visit.wait_for("question")
    page.locator("#answers button").nth(1).tap()
    visit.wait_for("form")
    shown = page.inner_text("body")
    assert not [word for word in ("Wait", "Answer", "Trial", "break", "Feel", "Send") if word in shown]
    page.locator("#fields input").fill("nach Gefühl")
    page.locator("#send").tap()
    visit.wait_for("done")
    assert study.end() == 0
    visit.context.close()
    with next((tmp_path / "data").glob("sub-07/beh/*.tsv")).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    found = [(row["answer"], row["response_time"] == "n/a", row["is_correct"], row["exclusion"]) for row in rows]
    assert found == [("n/a", True, "n/a", "no_answer"), ("second", False, "1", "n/a")]


def test_a_number_is_typed(make_study, browser, tmp_path, axe):
    text = STUDY.format(more="").partition("[[questions]]")[0]
    head, _, response = text.partition("[practice]")
    number = '[response]\nkind = "number"\nquestion = "How rough?"\n'
    assert "[response]" in response
    text = head + number
    study = make_study(text)
    visit = StudyVisit(browser, study.urls["participant"])
    page, typed = visit.page, iter(("12,5", "0.5"))

    def answer():
        expect(page.locator("#confirm")).to_have_attribute("aria-disabled", "true")
        check_with_axe(visit, axe)
        page.locator("#number").fill("no number")
        expect(page.locator("#confirm")).to_have_attribute("aria-disabled", "true")
        page.locator("#number").fill(next(typed))
        page.locator("#number").press("Enter")

    assert visit.take(answer) == "done"
    assert study.end() == 0
    visit.context.close()
    records = read_records(next((tmp_path / "data").rglob("*_trials.jsonl")))
    assert [record["answer"] for record in records if record["record"] == "trial"] == [12.5, 0.5]


def test_the_intervals_are_marked_in_their_order(make_study, browser):
    study = make_study(STUDY.format(more="").partition("[[questions]]")[0].replace("seconds = 0.2", "seconds = 0.8"))
    visit = StudyVisit(browser, "about:blank")
    visit.context.add_init_script(HISTORY)
    page, shown = visit.page, []
    page.goto(study.urls["participant"])
    visit.wait_for("start")
    page.locator("#begin").click()
    while "Part 1, Feel, Part 2" not in ", ".join(shown):  # once more for a computer that was late
        visit.wait_for("question")
        seen = [state for phase, _, state, _ in page.evaluate("window.history_seen") if phase == "stimulus"]
        shown = [state for k, state in enumerate(seen) if k == 0 or state != seen[k - 1]]
        page.evaluate("window.history_seen = []")
        page.keyboard.press("0")
        visit.wait_for_other("question")
    visit.context.close()
