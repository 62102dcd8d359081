"""The operator's page of a study beside the participant's: what it shows, pause, and STOP."""

import pytest
from playwright.sync_api import expect

from rig import wait_for
from study_page_rig import PageStudy
from study_rig import find_defects, read_records, write_study
from study_visit import StudyVisit

TRIALS = 3


@pytest.fixture
def study(bench, tmp_path):
    bench.daemon.arm()
    study = PageStudy(tmp_path, bench.daemon, write_study(tmp_path, repetitions=1))
    assert study.read_urls(), study.said
    yield study
    study.kill()


@pytest.fixture
def visits(browser, study):
    """Both pages: the participant's and the operator's."""
    found = [StudyVisit(browser, study.urls[role]) for role in ("participant", "operator")]
    yield found
    for visit in found:
        visit.context.close()


def read_trials(folder):
    records = read_records(next((folder / "data").rglob("*_trials.jsonl")))
    return records, [record for record in records if record["record"] == "trial"]


def test_pause_lets_no_further_stimulus_begin_until_the_operator_goes_on(study, visits, tmp_path, bench):
    participant, operator = visits
    participant.wait_for("start")
    participant.page.locator("#begin").click()
    participant.wait_for("question")
    operator.page.locator("#pause").click()
    expect(operator.page.locator("#pause")).to_have_text("Go on")
    participant.page.keyboard.press("2")
    participant.wait_for("pause")
    pulses = len(bench.board.of("pulse"))
    operator.page.reload()
    expect(operator.page.locator("#state")).to_have_text("Paused")
    participant.page.keyboard.press("3")
    assert [record["answer"] for record in read_trials(tmp_path)[1]] == ["2-3"]
    assert sum(record["record"] == "begun" for record in read_trials(tmp_path)[0]) == 1
    assert len(bench.board.of("pulse")) == pulses
    operator.page.locator("#pause").click()
    assert participant.take(lambda: participant.page.keyboard.press("3")) == "done"
    assert study.end() == 0
    records, trials = read_trials(tmp_path)
    assert find_defects(records) == []
    assert [trial["answer"] for trial in trials] == ["2-3", "3-4", "3-4"]


@pytest.mark.parametrize("phase", ["stimulus", "question"])
def test_stop_ends_dark_and_the_same_command_goes_on(study, visits, tmp_path, bench, phase):
    participant, operator = visits
    participant.wait_for("start")
    participant.page.locator("#begin").click()
    participant.wait_for(phase)
    if phase == "stimulus":
        wait_for(lambda: bench.board.of("pulse"), "light")
    operator.page.keyboard.press("Escape")
    participant.wait_for("stopped")
    expect(operator.page.locator("#notice")).to_contain_text("stopped")
    assert study.end() == 1
    assert bench.daemon.board_state() == "DISARMED"
    assert bench.board.of("gate")[-1]["on"] is False
    bench.daemon.arm()
    again = PageStudy(tmp_path, bench.daemon, write_study(tmp_path, repetitions=1))
    assert again.read_urls(), again.said
    participant.page.goto(again.urls["participant"])
    assert participant.take(lambda: participant.page.keyboard.press("2")) == "done"
    assert again.end() == 0
    records, trials = read_trials(tmp_path)
    assert find_defects(records) == []
    assert len(trials) == TRIALS
    assert any(record["record"] in ("interrupted", "spoiled") for record in records)


def test_a_participants_secret_opens_no_operators_page(study, browser):
    visit = StudyVisit(browser, study.urls["participant"].replace("/participant#", "/operator#"))
    expect(visit.page.locator("#notice")).to_contain_text("not valid")
    assert visit.page.locator("#rows tr").count() == 0
    visit.context.close()
