"""Owners of the plans that play and wait, the caller who armed the board, and the rights of the role."""

import json
import re
from socket import create_connection

import pytest
from playwright.sync_api import expect
from websockets.sync.client import connect

from rig import TOKEN, read_role_tokens, wait_for
from service_manager import Manager, reload
from window import arm, list_violations, play_for, press_escape


def test_what_plays_and_waits_is_named_and_can_be_cancelled(page, daemon):
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
    check_state(daemon, running, first, second)
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


def check_state(daemon, *plans):
    """Compare the state with three plans, which last for 8, 3 and 4 s. The first one runs."""
    wait_for(lambda: daemon.state()["queue"]["active"][0]["executed"] > 10, "light")
    queue = daemon.state()["queue"]
    first, second, _ = queue["active"]
    assert [plan["plan"] for plan in queue["active"]] == list(plans)
    assert (queue["running"], queue["waiting"]) == (plans[0], 2)
    assert (first["status"], second["status"]) == ("running", "queued")
    assert {first["caller"], second["caller"], daemon.call("GET", f"/v1/plans/{plans[1]}")["caller"]} == {"armer"}
    assert 0 < first["executed"] < first["planned"] == 400
    assert first["starts_in_s"] < 0 < first["ends_in_s"] < 8.0
    assert (
        second["ends_in_s"] - second["starts_in_s"] == pytest.approx(second["duration_s"]) == pytest.approx(3, abs=0.1)
    )
    assert queue["plans"][-1] == {key: queue["active"][-1][key] for key in queue["plans"][-1]}


ROLES = {
    "viewer": {"Arm …": "armer"} | dict.fromkeys(("Disarm", "Maximum power", "Pause", "Preview", "End p"), "operator"),
    "operator": {"Arm …": "armer"},
    "armer": {},
}
"""Role → the controls that it may not use, each with the role that may."""


def test_the_role_is_shown_and_what_it_may_not_use_is_disabled(window, page, daemon, axe):
    for role, refused in ROLES.items():
        daemon.arm()
        play_for(daemon, 20.0)
        window.sign_in(read_role_tokens(daemon)[role])
        expect(page.locator("#caller")).to_have_text(role)
        page.locator("#now").wait_for()
        for name in ("Disarm", "Pause", "Preview", "End p"):
            button = page.get_by_role("button", name=name)
            expect(button).to_be_disabled() if name in refused else expect(button).to_be_enabled()
        reasons = page.locator(".reason").locator("visible=true").all_inner_texts()
        assert len(reasons) == len(refused)
        for required in refused.values():
            said = f"needs the role {required}; token “{role}” has the role {role}."
            assert any(said in text for text in reasons)
        if refused:
            assert list_violations(page, axe) == []
        press_escape(page)
        expect(page.locator("#board-state")).to_have_text("DISARMED")
        arming = page.get_by_role("button", name="Arm …")
        expect(arming).to_be_disabled() if refused else expect(arming).to_be_enabled()
    assert window.unexpected_errors() == []


def test_the_frames_of_a_stream_are_one_entry_of_the_history(page, daemon):
    daemon.arm()
    plans = page.get_by_role("list", name="Plans").get_by_role("listitem")
    link = create_connection(("127.0.0.1", daemon.client.base_url.port))
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with connect("ws://127.0.0.1/v1/stream", sock=link, additional_headers=headers, proxy=None) as stream:
        for number in range(4):
            stream.send(json.dumps({"frame": number, "target_um": {"17": 100}}))
            while json.loads(stream.recv())["status"] != "done":
                pass
            expect(plans.first).to_have_text(re.compile(rf"frame {number} by armer: done, 1 of 1 pulses$"))
    entries = plans.all_inner_texts()
    assert sum("frame" in entry for entry in entries) == 1


def read_focus(page):
    return page.evaluate("document.activeElement.id")


def test_confirm_follows_arm_within_five_seconds_and_the_focus_is_kept(page, daemon):
    page.get_by_role("button", name="Arm …").focus()
    page.keyboard.press("Enter")
    expect(page.locator("#confirm-arm")).to_be_visible()
    page.keyboard.press("Tab")
    assert read_focus(page) == "confirm-arm"
    expect(page.locator("#confirm-arm")).to_be_hidden()  # the time is up
    expect(page.locator("#said p").last).to_have_text("Not armed.")
    assert read_focus(page) == "arm"
    assert daemon.board_state() == "DISARMED"
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    assert read_focus(page) == "arm"
    expect(page.locator("#board-state")).to_have_text("ARMED")
    assert read_focus(page) == "arm"
    expect(page.get_by_role("button", name="Arm …")).to_be_disabled()
    page.keyboard.press("Enter")
    expect(page.locator("#confirm-arm")).to_be_hidden()
    for following in ("hold", "disarm"):
        page.keyboard.press("Tab")
        assert read_focus(page) == following


def look_at_hold(page, daemon):
    expect(page.locator("#board-state")).to_have_text("RUNNING")
    expect(page.locator("#control")).to_have_text(
        re.compile(r"^Armed by armer \(this page’s token\) \d s ago, while held\.$")
    )
    assert daemon.state()["control"]["hold"]


def test_hold_to_run_plays_what_was_previewed_until_it_is_released(page, daemon, bench, axe):
    page.locator("#display").focus()
    page.keyboard.press("Space")
    page.get_by_label("For, s").fill("20")
    page.get_by_label("Rate, Hz").fill("10")
    page.get_by_role("button", name="Preview").click()
    expect(page.get_by_role("button", name="Play")).to_be_enabled()
    hold = page.get_by_role("button", name="Hold to run")
    hold.hover()
    page.mouse.down()
    look_at_hold(page, daemon)
    assert list_violations(page, axe, "#control, #hold, #bar") == []
    page.mouse.up()
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    assert bench.board.of("gate")[-1]["on"] is False
    assert daemon.state()["queue"]["active"] == []

    hold.focus()
    page.keyboard.down("Space")
    look_at_hold(page, daemon)
    press_escape(page)  # with the key still down
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    expect(page.locator("#hold-ended")).to_have_text("No longer held: ended by stop.")
    page.keyboard.up("Space")

    daemon.arm()
    expect(hold).to_be_disabled()
    hold.dispatch_event("pointerdown", {"button": 0})
    expect(page.locator("#board-state")).to_have_text("ARMED")
    assert not daemon.state()["control"]["hold"]


@pytest.mark.parametrize("loss", ["hidden", "navigated", "stalled"])
def test_a_page_that_is_not_there_holds_nothing(page, daemon, loss):
    page.get_by_role("button", name="Hold to run").focus()
    page.keyboard.down("Enter")
    expect(page.locator("#board-state")).to_have_text("ARMED")
    if loss == "hidden":
        page.evaluate("Object.defineProperty(document, 'hidden', {configurable: true, value: true})")
        page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    elif loss == "navigated":
        page.goto("about:blank")
    else:
        page.evaluate("setTimeout(() => { for (const end = Date.now() + 2000; Date.now() < end; ); })")
    wait_for(lambda: daemon.board_state() == "DISARMED", "the arming to end")
    assert daemon.state()["control"] is None
    page.keyboard.up("Enter")


def press_key_and_wait(page, key):
    with page.expect_response("**/v1/dim"):
        page.keyboard.press(key)


def test_the_power_is_dimmed_by_operators_and_raised_by_armers(window, page, daemon, axe):
    slider = page.get_by_role("slider", name="Maximum power")
    mark = page.locator("#dimmed")
    expect(slider).to_have_value("100")
    expect(mark).to_be_hidden()
    window.sign_in(read_role_tokens(daemon)["operator"])
    expect(page.locator("#caller")).to_have_text("operator")
    expect(slider).to_be_enabled()
    slider.focus()
    for _ in range(2):
        press_key_and_wait(page, "PageDown")
    share = daemon.state()["limits"]["power_share"]
    assert share in (0.8, 0.9)
    expect(mark).to_have_text(f"≤ {share:.0%}".replace("%", " %"))
    expect(page.locator("#dim-note")).to_have_text("Applies from the next plan on.")
    page.keyboard.press("ArrowUp")
    expect(page.locator("#dim-note")).to_have_text("Raising the power needs the role armer.")
    assert list_violations(page, axe) == []
    assert daemon.state()["limits"]["power_share"] == share
    daemon.call("PUT", "/v1/dim", json={"share": 0.25})
    expect(mark).to_have_text("≤ 25 %")
    page.locator("#display").focus()
    expect(slider).to_have_value("25")

    window.sign_in(read_role_tokens(daemon)["viewer"])
    expect(slider).to_be_disabled()
    window.sign_in(TOKEN)
    daemon.arm()
    planned = play_for(daemon, 3.0)
    expect(page.locator("#timeline-text")).to_contain_text("of them trimmed (dimmed power)")
    assert set(daemon.call("GET", f"/v1/plans/{planned}")["summary"]["trimmed"]["by_reason"]) == {"dim"}
    slider.focus()
    press_key_and_wait(page, "End")
    expect(mark).to_be_hidden()
    assert daemon.state()["limits"]["power_share"] == 1.0


def test_the_light_is_paused_and_resumed_with_one_button(page, daemon, bench, axe):
    button = page.locator("#pause")
    expect(button).to_be_disabled()
    daemon.arm()
    plan = play_for(daemon, 4.0)
    wait_for(lambda: len(bench.board.of("pulse")) > 5, "light")
    expect(page.locator("#board-state")).to_have_text("RUNNING")
    button.focus()
    page.keyboard.press("Enter")
    expect(page.locator("#board-state")).to_have_text("PAUSED")
    expect(page.locator("#board-means")).to_have_text(re.compile(r"^dark, armed for (5:00|4:5\d) min$"))
    expect(page.locator("#said")).to_have_text(re.compile("Paused: the laser is off"))
    expect(page.locator("#now .left")).to_have_text(re.compile(r"^\d+ of 200 pulses, paused$"))
    expect(page).to_have_title(re.compile("^PAUSED · "))
    assert bench.board.of("gate")[-1]["on"] is False
    assert list_violations(page, axe) == []
    expect(button).to_have_text("Resume")
    assert read_focus(page) == "pause"
    page.keyboard.press("Space")
    expect(page.locator("#board-state")).to_have_text("RUNNING")
    expect(button).to_have_text("Pause")
    assert daemon.finished(plan)["executed"] == 200


ANNA = "a-token-for-anna"


def write_tokens(path, **secrets):
    entries = (f'[[token]]\nname = "{name}"\nrole = "armer"\nsecret = "{secrets[name]}"\n' for name in secrets)
    path.write_text('format = "optodrive-tokens"\nversion = 1\n' + "".join(entries))
    path.chmod(0o600)


@pytest.fixture
def manager(tmp_path, monkeypatch):
    manager = Manager(tmp_path, monkeypatch)
    yield manager
    manager.close()


def test_a_page_whose_token_is_revoked_says_so(kept_window, bench, axe, tmp_path, manager):
    path = tmp_path / "tokens.toml"
    write_tokens(path, rig=TOKEN, anna=ANNA)
    bench.restart_daemon(replace=[("lease_s = 1.0", f'lease_s = 1.0\n[daemon]\ntokens = "{path}"\n#')])
    kept_window.reset(ANNA)
    page, daemon = kept_window.page, bench.daemon
    control = page.locator("#control")
    daemon.arm()
    expect(control).to_have_text(re.compile(r"^Armed by rig \d s ago\.$"))
    daemon.call("POST", "/v1/disarm")
    expect(control).to_be_hidden()
    arm(page)
    expect(control).to_have_text(re.compile(r"^Armed by anna \(this page’s token\) \d s ago\.$"))
    write_tokens(path, rig=TOKEN)
    reload(daemon, manager, str)
    trouble = page.locator("#trouble").filter(has_text="The token 'anna' was revoked.")
    expect(trouble).to_be_visible()
    expect(page.locator("#board-state")).to_have_text("UNKNOWN")
    expect(page.locator("#caller")).to_have_text("token not valid")
    for name in ("Arm …", "Disarm", "Preview"):
        expect(page.get_by_role("button", name=name)).to_be_disabled()
    expect(page.locator("#fault-history")).to_have_text("None.")
    assert list_violations(page, axe) == []
    wait_for(lambda: daemon.board_state() == "DISARMED", "the arming of anna to end")
    trouble.get_by_role("link", name="Enter another one").click()
    page.get_by_label("Token of this daemon").fill(TOKEN)
    page.keyboard.press("Enter")
    expect(page.locator("#caller")).to_have_text("rig, armer")
