"""The participant's page of a study: by keys, by touch and with a screen reader, and the answers that count."""

import httpx
import pytest
from playwright.sync_api import expect
from websockets.exceptions import InvalidStatus

from optodrive.core.errors import InputError
from optodrive.link.session.clock_sync import CLOCK_SPAN_S, DRIFT_MAX
from optodrive.study.page_messages import parse_page_address
from study_page_rig import PageStudy, open_wire
from study_rig import find_defects, read_records, write_study
from study_visit import StudyVisit
from test_accessibility import LISTEN
from window import PHONE, WIDE, list_violations

TRIALS = 3
LONG = """
format = "optodrive-study"
version = 1
name = "long"
title = "Long"
seed = 3
repetitions = 2
pause_s = {pause_s}

[stimulus]
pattern = "vibration"
parameters = {{seconds = 4.0}}

[factors]
height_um = [50]

[response]
kind = "magnitude"
question = "How strong was it?"
"""


@pytest.fixture
def make_study(bench, tmp_path):
    """Return a function that starts a study on the armed display."""
    bench.daemon.arm()
    studies = []

    def make(text=None, **options):
        path = write_study(tmp_path, repetitions=1)
        if text is not None:
            path.write_text(text)
        studies.append(PageStudy(tmp_path, bench.daemon, path, **options))
        assert studies[-1].read_urls(), studies[-1].said
        return studies[-1]

    yield make
    for study in studies:
        study.kill()


@pytest.fixture
def study(make_study):
    return make_study()


@pytest.fixture
def open_page(browser):
    """Return a function that opens a participant's page of a study."""
    visits = []

    def open_visit(study, **options):
        visits.append(StudyVisit(browser, study.urls["participant"], **options))
        return visits[-1]

    yield open_visit
    for visit in visits:
        visit.context.close()


@pytest.fixture
def records(tmp_path):
    """Return a function that reads the log of the session."""
    return lambda: read_records(next((tmp_path / "data").rglob("*_trials.jsonl")))


def list_trials(records):
    assert find_defects(records) == []
    return [record for record in records if record["record"] == "trial"]


def test_a_session_by_single_keys(study, open_page, records):
    visit = open_page(study)
    keys = iter("243")
    assert visit.wait_for("start") == "start"
    visit.page.keyboard.press("Enter")  # the button has the focus
    visit.wait_for_other("start")
    assert visit.take(lambda: visit.page.keyboard.press(next(keys))) == "done"
    assert study.end() == 0
    trials = list_trials(records())
    assert [trial["answer"] for trial in trials] == ["2-3", "4-5", "3-4"]
    assert {trial["attempt"] for trial in trials} == {1}
    for trial in trials:
        assert trial["response_time_s"] > 0.0
        assert trial["response_latency_s"] > 0.0
        assert trial["early_answers"] == 0
    assert visit.errors == []


def test_a_session_by_touch_on_a_phone(study, open_page, records):
    visit = open_page(study, viewport=PHONE, has_touch=True, is_mobile=True)
    page = visit.page
    visit.wait_for("start")
    page.locator("#begin").tap()
    visit.wait_for_other("start")

    def tap():
        button = page.locator("#answers button").nth(2)
        assert button.bounding_box()["height"] >= 60
        button.tap()

    assert visit.take(tap) == "done"
    assert study.end() == 0
    assert [trial["answer"] for trial in list_trials(records())] == ["4-5"] * TRIALS


def test_keys_can_be_switched_off(study, open_page, records):
    visit = open_page(study)
    visit.page.get_by_label("Answer with single keys").uncheck()

    def answer():
        visit.page.keyboard.press("2")
        visit.page.keyboard.press("0")
        visit.page.locator("#answers button").nth(1).click()

    assert visit.take(answer) == "done"
    assert study.end() == 0
    trials = list_trials(records())
    assert [trial["answer"] for trial in trials] == ["3-4"] * TRIALS
    assert {len(trial["presentations"]) for trial in trials} == {1}


def test_each_state_is_said_once(study, open_page):
    visit = open_page(study)
    visit.wait_for("start")
    visit.page.evaluate(LISTEN)
    visit.take(lambda: visit.page.keyboard.press("2"))
    said = [text for _, text in visit.page.evaluate("window.heard")]
    expected = []
    for number in range(1, TRIALS + 1):
        expected += [f"Trial {number} of {TRIALS}. Feel.", "Answer now. Which?"]
    assert [text for text in said if not text.startswith("Wait. ")] == [
        *expected,
        "Finished. Thank you. You may take your finger away.",
    ]


def check_with_axe(visit, axe):
    for scheme, viewport in (("light", WIDE), ("dark", PHONE), ("light", PHONE), ("dark", WIDE)):
        visit.page.emulate_media(color_scheme=scheme)
        visit.page.set_viewport_size(viewport)
        assert list_violations(visit.page, axe) == [], (scheme, viewport)
        assert visit.page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_axe_finds_nothing_in_choices(study, open_page, axe):
    visit = open_page(study)
    visit.wait_for("start")
    check_with_axe(visit, axe)

    def answer():
        check_with_axe(visit, axe)
        visit.page.keyboard.press("2")

    assert visit.take(answer) == "done"
    check_with_axe(visit, axe)


def test_axe_finds_nothing_in_a_stimulus_a_scale_a_rest_and_after_the_end(make_study, open_page, axe, records):
    study = make_study(LONG.format(pause_s=2.0))
    visit = open_page(study)
    page = visit.page
    visit.wait_for("start")
    page.locator("#begin").click()
    visit.wait_for("stimulus")
    check_with_axe(visit, axe)
    visit.wait_for("question")
    expect(page.locator("#confirm")).to_have_attribute("aria-disabled", "true")
    page.locator("#confirm").click(force=True)
    page.locator("#magnitude").focus()
    page.keyboard.press("End")
    page.keyboard.press("ArrowLeft")
    expect(page.locator("#value")).to_have_text("0.98")
    check_with_axe(visit, axe)
    page.locator("#confirm").press("Enter")
    visit.wait_for("rest")
    check_with_axe(visit, axe)
    visit.wait_for("question")
    expect(page.locator("#value")).to_have_text("no answer yet")
    study.kill()
    visit.wait_for("lost")
    assert visit.read_state()[0] == "No connection"
    check_with_axe(visit, axe)
    assert [record["answer"] for record in records() if record["record"] == "trial"] == [0.98]


def test_a_participant_may_feel_a_stimulus_again(study, open_page, records):
    visit = open_page(study)
    presses = iter("02")
    assert visit.take(lambda: visit.page.keyboard.press(next(presses, "2"))) == "done"
    assert study.end() == 0
    first, *others = list_trials(records())
    assert [shown.get("repeated") for shown in first["presentations"]] == ["requested", None]
    assert {len(trial["presentations"]) for trial in others} == {1}


def interrupt_by_reload(visit, open_page, study):
    visit.page.reload()
    return visit


def interrupt_by_another_window(visit, open_page, study):
    other = open_page(study)
    other.wait_for("start")
    visit.wait_for("lost")
    assert visit.read_state()[0] == "Not in use"
    visit.page.keyboard.press("3")  # of the window that is not in use
    return other


def interrupt_by_a_break(visit, open_page, study):
    visit.page.locator("#break").click()
    visit.wait_for("start")
    assert visit.read_state()[0] == "Break"
    return visit


def interrupt_by_closing(visit, open_page, study):
    visit.context.close()
    return open_page(study)


INTERRUPTIONS = [interrupt_by_reload, interrupt_by_another_window, interrupt_by_a_break, interrupt_by_closing]


@pytest.mark.parametrize(
    ("interrupt", "phase"),
    [*((each, "question") for each in INTERRUPTIONS), *((each, "stimulus") for each in INTERRUPTIONS[:2])],
)
def test_a_page_that_is_lost_or_replaced_pauses_the_session(study, open_page, records, interrupt, phase):
    visit = open_page(study)
    visit.wait_for("start")
    visit.page.locator("#begin").click()
    visit.wait_for(phase)
    visit = interrupt(visit, open_page, study)
    assert visit.wait_for("start") == "start"
    begun = sum(record["record"] == "begun" for record in records())
    assert begun == 1
    assert visit.take(lambda: visit.page.keyboard.press("2")) == "done"
    assert study.end() == 0
    first, *others = list_trials(records())
    assert [shown.get("repeated") for shown in first["presentations"]] == ["interrupted", None]
    assert first["attempt"] == 1
    assert {len(trial["presentations"]) for trial in others} == {1}


def wait_for_question(wire, before):
    """Wait for the question about another presentation than the one before, and return its key."""
    while (announced := wire.wait_for("question")["announced"]) == before:
        pass
    return announced


def find_clock_error_us(daemon):
    """Return the uncertainty of the board's clock by the round trip that the link states."""
    return 0.5 * (1e3 * daemon.state()["link"]["round_trip_ms"] + 1e6 * DRIFT_MAX * CLOCK_SPAN_S)


def test_the_response_time_is_that_between_the_boards_last_gate_off_and_the_answer(study, records, bench):
    bounds_us, announced, errors_us = [], None, [find_clock_error_us(bench.daemon)]
    with open_wire(study.urls["participant"]) as wire:
        wire.send("ready")
        for _ in range(TRIALS):
            announced = wait_for_question(wire, announced)
            before_us = bench.board.now_us()
            wire.send("answer", answer="2-3", handled_s=0.0, **announced)
            is_last = len(bounds_us) == TRIALS - 1
            wire.wait_for("done" if is_last else "stimulus")
            bounds_us.append((before_us, bench.board.now_us()))
            errors_us.append(find_clock_error_us(bench.daemon))
    assert study.end() == 0
    ends_us = sorted(event["off_us"] for event in bench.board.of("pulse"))
    trials = list_trials(records())
    pulses = len(trials[0]["presentations"][0]["executed"]["pixel"])
    assert len(ends_us) == TRIALS * pulses
    for number, (trial, (before_us, after_us)) in enumerate(zip(trials, bounds_us, strict=True), start=1):
        answered_us = ends_us[number * pulses - 1] + 1e6 * trial["response_time_s"]
        assert before_us - max(errors_us) <= answered_us <= after_us + max(errors_us)


@pytest.mark.parametrize("role", ["participant", "operator"])
def test_a_message_that_is_none_closes_the_page_and_the_session_waits(study, role):
    answer = '{"kind": "answer", "trial": -1, "attempt": 1, "presentation": 1, "answer": "x", "handled_s": 0}'
    texts = ["{}", "no JSON", "[]", '{"kind": "answer"}', '{"kind": "stop", "more": 1}', answer]
    for text, code in (*((each, 1008) for each in texts), (" " * 20_000, 1009), (b'{"kind": "\xff"}', 1007)):
        with open_wire(study.urls[role], role) as wire:
            wire.wait_for("start")
            wire.socket.send(text, text=True)
            assert wire.read_close()[0] == code, text
    assert study.process.poll() is None


def test_a_page_shows_nothing_to_the_other_ones_token_or_none(study):
    for role, secret in (("operator", "participant"), ("participant", "operator")):
        for url in (study.urls[secret], f"{study.urls[role].partition('#')[0]}#token=x"):
            with open_wire(url, role) as wire:
                assert wire.read_close() == (4401, 0)


BROKEN = """(() => {
    const add = WebSocket.prototype.addEventListener;
    WebSocket.prototype.addEventListener = function (type, listener) {
        const seeBroken = () => (document.body.dataset.closed = listener({ code: 1006 }));
        add.call(this, type, type === "close" ? seeBroken : listener);
    };
})()"""
"""Lets a page see every end of a connection as a broken one."""


def test_the_end_stays_on_the_page_when_the_connection_breaks_with_it(study, open_page):
    visit = open_page(study)
    visit.context.add_init_script(BROKEN)
    visit.page.reload()
    assert visit.take(lambda: visit.page.keyboard.press("2")) == "done"
    assert study.end() == 0
    visit.page.locator("body[data-closed]").wait_for()
    assert visit.read_state()[0] == "Finished"


def test_a_wrong_address_is_said(study, browser):
    visit = StudyVisit(browser, study.urls["participant"][:-1])
    visit.wait_for("lost")
    assert visit.read_state()[0] == "Not valid"
    visit.context.close()


def test_host_origin_paths_and_headers(study):
    url = study.urls["participant"].partition("#")[0]
    base = url.rpartition("/")[0]
    good = httpx.get(url)
    assert good.status_code == 200
    assert "default-src 'self'" in good.headers["content-security-policy"]
    assert good.headers["x-frame-options"] == "DENY"
    assert httpx.get(url, headers={"Host": "evil.example"}).status_code == 421
    assert httpx.get(url, headers={"Origin": "http://evil.example"}).status_code == 403
    assert httpx.get(url, headers={"Origin": base}).status_code == 200
    assert httpx.get(f"{base}/page/nothing.js").status_code == 404
    assert httpx.get(f"{base}/page/..%2f__init__.py").status_code == 404
    assert httpx.post(url, content=b"x" * 100_000).status_code == 405
    for header in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
        with pytest.raises(InvalidStatus, match="HTTP 4"), open_wire(url, additional_headers=header):
            pass
    host, _, port = base.removeprefix("http://").partition(":")
    assert host == "127.0.0.1"
    assert httpx.get(url, headers={"Host": f"localhost:{port}"}).status_code == 200


def test_a_wrong_port_is_refused_in_one_line():
    for page in ("x", "1:2:3", "70000", "127.0.0.1:", "0.0.0.0:0"):
        with pytest.raises(InputError, match=r"^--page: got [^\n]*$"):
            parse_page_address("--page", page)


def test_a_port_in_use_is_told_in_one_line(study, bench, tmp_path):
    port = study.urls["participant"].partition("/participant")[0].rpartition(":")[2]
    other = PageStudy(tmp_path / "other", bench.daemon, write_study(tmp_path), port=port)
    assert not other.read_urls()
    assert other.end() == 2
    assert "--page: got " in other.said
    assert other.said.count("\n") == 1
