"""Whose plans play and wait, what the role may use, and the history."""

import json
import re
from socket import create_connection

import pytest
from playwright.sync_api import expect
from websockets.sync.client import connect

from rig import TOKEN, read_role_tokens, wait_for
from window import INTERLOCK, play_for, press_escape

SAFE_INPUTS = 0b011  # interlock closed, key on, emergency stop released


def test_what_plays_and_waits_is_named_and_can_be_cancelled(visit, daemon):
    page = visit(daemon).open()
    playing = page.get_by_role("region", name="Playing")
    expect(playing).to_contain_text("Nothing plays.")
    daemon.arm()
    running, first, second = (play_for(daemon, seconds) for seconds in (8.0, 3.0, 4.0))
    now = page.locator("#now")
    expect(now.locator(".plan")).to_have_text(f"{running} push by armer")
    expect(now.locator(".left")).to_have_text(re.compile(r"^[1-9]\d* of 400 pulses, [0-7]\.\d s left$"))
    rows = page.get_by_role("list", name="Waiting plans").get_by_role("listitem")
    expect(rows).to_have_count(2)
    expect(rows.nth(0)).to_have_text(re.compile(f"^{first} push by armer3.0 s, starts in [5-8] s"))
    page.get_by_role("button", name=f"Cancel {first} push").click()
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text(second)
    assert daemon.finished(first)["status"] == "cancelled"
    page.get_by_role("button", name=f"End {running} push").click()
    expect(now.locator(".plan")).to_have_text(f"{second} push by armer")
    assert daemon.finished(running)["status"] == "cancelled"
    assert daemon.board_state() in ("ARMED", "RUNNING")
    press_escape(page)
    expect(playing).to_contain_text("Nothing plays.")
    expect(rows).to_have_count(0)


def test_the_state_tells_whose_plans_run_and_wait(daemon):
    daemon.arm()
    running, waiting = play_for(daemon, 6.0), play_for(daemon, 2.0)
    wait_for(lambda: daemon.state()["queue"]["active"][0]["executed"] > 10, "light")
    queue = daemon.state()["queue"]
    first, second = queue["active"]
    assert (first["plan"], second["plan"], queue["running"], queue["waiting"]) == (running, waiting, running, 1)
    assert (first["status"], second["status"]) == ("running", "queued")
    assert {first["caller"], second["caller"], daemon.call("GET", f"/v1/plans/{waiting}")["caller"]} == {"armer"}
    assert 0 < first["executed"] < first["planned"] == 300
    assert first["starts_in_s"] < 0 < first["ends_in_s"] < 6.0
    assert (
        second["ends_in_s"] - second["starts_in_s"] == pytest.approx(second["duration_s"]) == pytest.approx(2, abs=0.1)
    )
    assert queue["plans"][-1] == {key: second[key] for key in queue["plans"][-1]}


@pytest.mark.parametrize(
    ("role", "refused"),
    [
        ("viewer", {"Arm …": "armer", "Disarm": "operator", "Preview": "operator", "End p": "operator"}),
        ("operator", {"Arm …": "armer"}),
        ("armer", {}),
    ],
)
def test_the_role_is_shown_and_what_it_may_not_use_is_disabled(visit, daemon, axe, role, refused):
    daemon.arm()
    play_for(daemon, 20.0)
    window = visit(daemon)
    page = window.open(read_role_tokens(daemon)[role])
    expect(page.locator("#caller")).to_have_text(role)
    page.locator("#now").wait_for()
    for name in ("Disarm", "Preview", "End p"):
        button = page.get_by_role("button", name=name)
        expect(button).to_be_disabled() if name in refused else expect(button).to_be_enabled()
    reasons = page.locator(".reason").locator("visible=true").all_inner_texts()
    assert len(reasons) == len(refused)
    for required in refused.values():
        assert any(f"needs the role {required}; token “{role}” has the role {role}." in text for text in reasons)
    page.evaluate(axe)
    assert page.evaluate("axe.run()")["violations"] == []
    press_escape(page)
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    arming = page.get_by_role("button", name="Arm …")
    expect(arming).to_be_disabled() if refused else expect(arming).to_be_enabled()
    assert window.unexpected_errors() == []


def test_faults_and_plans_stay_in_the_history_across_a_reload(visit, make_board, make_daemon):
    daemon = make_daemon(make_board(script=INTERLOCK))
    window = visit(daemon)
    page = window.open()
    faults = page.get_by_role("list", name="Faults").get_by_role("listitem")
    plans = page.get_by_role("list", name="Plans").get_by_role("listitem")
    expect(faults).to_have_text(["None."])
    daemon.arm()
    failed, waiting = play_for(daemon, 8.0), play_for(daemon, 1.0)
    expect(faults).to_have_text([re.compile(r"^\d.*\d INTERLOCK: the interlock opened")])
    expect(plans).to_have_text(
        [
            re.compile(rf"\d {waiting} push by armer: failed \(.*INTERLOCK.*\), 0 of 50 pulses$"),
            re.compile(rf"\d {failed} push by armer: failed \(.*INTERLOCK.*\), [1-9]\d* of 400 pulses$"),
        ]
    )
    wait_for(lambda: daemon.state()["board"]["inputs"] == SAFE_INPUTS, "the interlock to close")
    page.get_by_role("button", name="Acknowledge").click()
    expect(faults).to_have_count(2)
    daemon.arm()
    done = play_for(daemon, 0.2)
    expect(plans.first).to_have_text(re.compile(f"{done} push by armer: done, 10 of 10 pulses"))
    texts = [(item.all_inner_texts()) for item in (faults, plans)]
    page.reload()
    page.get_by_text("live", exact=True).wait_for()
    page.wait_for_timeout(600)  # the state event, which must add nothing
    assert [(item.all_inner_texts()) for item in (faults, plans)] == texts
    assert window.unexpected_errors() == []


def test_the_frames_of_a_stream_are_one_entry_of_the_history(visit, daemon):
    page = visit(daemon).open()
    daemon.arm()
    plans = page.get_by_role("list", name="Plans").get_by_role("listitem")
    link = create_connection(("127.0.0.1", daemon.client.base_url.port))
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with connect("ws://127.0.0.1/v1/stream", sock=link, additional_headers=headers, proxy=None) as stream:
        for number in range(4):
            stream.send(json.dumps({"frame": number, "target_um": {"17": 100}}))
            while json.loads(stream.recv(timeout=20))["status"] != "done":
                pass
            expect(plans.first).to_have_text(re.compile(rf"frame {number} by armer: done, 1 of 1 pulses$"))
    entries = plans.all_inner_texts()
    assert sum("frame" in entry for entry in entries) == 1
