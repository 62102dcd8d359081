"""The page as an operator uses it beside a laser: STOP, states, plans, roles and history."""

import re
import signal

import pytest
from playwright.sync_api import expect

from rig import long_train, read_role_tokens, wait_for
from test_page import INTERLOCK, arm
from window import PHONE, WIDE

SAFE_INPUTS = 0b011  # interlock closed, key on, emergency stop released
STOP = "**/v1/stop"


def press_escape(page):
    """Press Escape and wait until STOP, which it must send, has been answered."""
    with page.expect_response(STOP, timeout=5_000):
        page.keyboard.press("Escape")
    expect(page.locator("#stopping")).to_be_hidden()


def test_escape_is_stop_while_any_control_is_open(visit, daemon):
    page = visit(daemon).open()
    page.get_by_text("Options").click()
    arm(page)
    for source in ("Draw", "Library"):
        page.get_by_text(source, exact=True).click()
        if source == "Library":
            page.locator("#pattern").select_option("experiment-2")
        controls = page.locator("main select, main input:not([type=file]), main button").locator("visible=true")
        assert controls.count() > 5
        for control in controls.element_handles():
            if control.is_visible() and control.is_enabled():
                control.click(force=True)  # the label of a radio button lies over it
                press_escape(page)
                expect(page.locator("#board-state")).to_have_text("DISARMED")


def test_escape_is_stop_while_a_file_dialog_is_open(visit, daemon):
    page = visit(daemon).open()
    devtools = page.context.new_cdp_session(page)
    devtools.send("Page.setInterceptFileChooserDialog", {"enabled": True, "cancel": True})
    arm(page)
    with page.expect_response(STOP, timeout=5_000):
        page.locator("#picture").click()
    expect(page.locator("#board-state")).to_have_text("DISARMED")


def test_the_browsers_menu_takes_no_escape_while_the_laser_may_emit(visit, daemon):
    page = visit(daemon).open()
    page.evaluate("addEventListener('contextmenu', (event) => (window.wasPrevented = event.defaultPrevented))")
    page.locator("#display").click(button="right")
    assert page.evaluate("window.wasPrevented") is False
    page.keyboard.press("Escape")
    arm(page)
    page.locator("#display").click(button="right")
    assert page.evaluate("window.wasPrevented") is True
    press_escape(page)


ESTOP_AND_KEY = """
[[step]]
from = "light"
at_s = 0.5
set = "estop"
value = true

[[step]]
from = "light"
at_s = 1.5
set = "key"
value = false
"""


def read_look(page):
    """Return what distinguishes a state in the header: word, outline of the sign, pattern of the border, ground."""
    return page.evaluate("""() => {
        const bar = document.getElementById("bar");
        const style = getComputedStyle(bar);
        return {
            word: document.getElementById("board-state").textContent,
            sign: document.getElementById("sign").getAttribute("d"),
            border: style.borderImageSource,
            ground: style.backgroundColor,
        };
    }""")


def play_for(daemon, seconds, **fields):
    return daemon.call("POST", "/v1/plans", json=long_train(seconds=seconds), **fields)["plan"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_disarmed_armed_and_running_differ_in_the_whole_header(visit, daemon, scheme):
    page = visit(daemon, color_scheme=scheme).open()
    state = page.locator("#board-state")
    expect(state).to_have_text("DISARMED")
    looks = [read_look(page)]
    arm(page)
    looks.append(read_look(page))
    play_for(daemon, 5.0)
    expect(state).to_have_text("RUNNING")
    looks.append(read_look(page))
    for what in ("word", "sign", "border", "ground"):
        assert len({look[what] for look in looks}) == 3, what
    expect(page).to_have_title(re.compile("^RUNNING · "))
    press_escape(page)
    expect(state).to_have_text("DISARMED")
    assert read_look(page) == looks[0]


def test_lamps_show_the_safety_inputs_and_the_header_the_fault(visit, make_board, make_daemon):
    board = make_board(script=ESTOP_AND_KEY)
    daemon = make_daemon(board)
    page = visit(daemon).open()
    lamps = page.get_by_role("list", name="Safety inputs").get_by_role("listitem")
    expect(lamps).to_have_text(["Interlock closed", "Key on", "E-stop released"])
    daemon.arm()
    play_for(daemon, 5.0)
    expect(page.locator("#board-state")).to_have_text("FAULT")
    expect(page.locator("#board-means")).to_have_text("ESTOP")
    expect(lamps).to_have_text(["Interlock closed", "Key off", "E-stop pressed"])
    assert [lamp.get_attribute("data-kind") for lamp in lamps.all()] == ["safe", "unsafe", "unsafe"]


def test_a_link_that_goes_down_while_it_runs_shows_nothing_as_known(visit, make_board, make_daemon):
    board = make_board()
    daemon = make_daemon(board)
    page = visit(daemon).open()
    daemon.arm()
    play_for(daemon, 10.0)
    expect(page.locator("#board-state")).to_have_text("RUNNING")
    board.stop()
    expect(page.locator("#board-state")).to_have_text("UNKNOWN")
    expect(page.locator("#board-means")).to_have_text("no link to the board")
    expect(page.locator("#lamps")).to_have_text(re.compile("Interlock unknown.*Key unknown.*E-stop unknown"))
    state = daemon.state()
    assert (state["link"]["state"], state["board"]["state"], state["board"]["fault"]) == ("down", "UNKNOWN", None)


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


def read_focus(page):
    return page.evaluate("document.activeElement.id")


def test_confirm_follows_arm_and_the_focus_is_kept(visit, daemon):
    page = visit(daemon).open()
    page.get_by_role("button", name="Arm …").focus()
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    assert read_focus(page) == "confirm-arm"
    expect(page.locator("#confirm-arm")).to_be_hidden()  # the time is up
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
    page.keyboard.press("Tab")
    assert read_focus(page) == "disarm"


def test_figures_that_stop_arriving_are_marked_as_stale(visit, make_board, make_daemon):
    daemon = make_daemon(make_board())
    page = visit(daemon).open()
    daemon.arm()
    play_for(daemon, 20.0)
    expect(page.locator("#board-state")).to_have_text("RUNNING")
    panels = [page.get_by_role("region", name=name) for name in ("Budgets", "Board", "Pulses", "Playing")]
    for panel in panels:
        expect(panel.locator(".stale-mark")).to_be_hidden()
    daemon.process.send_signal(signal.SIGSTOP)
    expect(page.locator("#board-state")).to_have_text("UNKNOWN", timeout=2_900)  # before the connection counts as lost
    for panel in panels:
        expect(panel.locator(".stale-mark")).to_have_text(re.compile(r"^stale since \d\d:\d\d:\d\d$"))
    expect(page.locator("#idle")).to_contain_text("Unknown")
    daemon.process.send_signal(signal.SIGCONT)
    expect(page.locator("#board-state")).to_have_text("FAULT")
    for panel in panels:
        expect(panel.locator(".stale-mark")).to_be_hidden()


def test_without_a_link_the_boards_figures_and_the_budgets_are_stale(visit, make_board, make_daemon):
    board = make_board()
    page = visit(make_daemon(board)).open()
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    board.stop()
    for name, is_stale in (("Board", True), ("Budgets", True), ("Playing", False)):
        mark = page.get_by_role("region", name=name, exact=True).locator(".stale-mark")
        expect(mark).to_be_visible() if is_stale else expect(mark).to_be_hidden()
    expect(page.locator("#link")).to_have_text("live")


def is_in_view(page, *items):
    """Return whether each item lies in the window as it is after loading, below the header."""
    assert page.evaluate("scrollY") == 0
    top = page.locator("#bar").bounding_box()["height"]
    boxes = [item.bounding_box() for item in items]
    return all(box["y"] >= top and box["y"] + box["height"] <= page.viewport_size["height"] for box in boxes)


def test_pulses_and_board_are_in_view_on_a_desktop(visit, daemon):
    page = visit(daemon, viewport=WIDE).open()
    panels = [page.get_by_role("region", name=name, exact=True) for name in ("Laser", "Budgets", "Board", "Pulses")]
    expect(page.locator("#figures dt")).not_to_have_count(0)
    expect(page.locator(".gauge")).not_to_have_count(0)
    assert is_in_view(page, *panels, page.get_by_role("button", name="Play", exact=True))
    daemon.arm()
    for seconds in (6.0, 2.0):
        play_for(daemon, seconds)
    expect(page.locator("#timeline-text")).to_contain_text("start within the next second")
    assert is_in_view(page, *panels)


def test_arm_and_confirm_are_in_view_on_a_phone(visit, daemon):
    page = visit(daemon, viewport=PHONE, has_touch=True).open()
    arming = page.get_by_role("button", name="Arm …")
    assert is_in_view(page, arming)
    arming.tap()
    assert is_in_view(page, arming, page.get_by_role("button", name="Confirm: arm the laser"))


def test_a_colour_means_the_same_height_all_the_time(visit, daemon):
    page = visit(daemon).open()
    top = page.locator("#legend-high")
    daemon.arm()
    for height_um in (30, 150):
        plan = daemon.call("POST", "/v1/patterns/checker", json={"height_um": height_um})["plan"]
        expect(page.locator("#summary")).to_contain_text("pixels above 1 µm")
        expect(top).to_have_text("≥ 200 µm")
        daemon.finished(plan)
    page.get_by_text("Options").click()
    page.get_by_text("100 µm", exact=True).click()
    expect(top).to_have_text("≥ 100 µm")
    page.reload()
    expect(top).to_have_text("≥ 100 µm")
    page.get_by_text("Temperature", exact=True).click()
    expect(top).to_have_text("≥ 400 °C")


def test_gauges_warn_from_80_and_95_percent(visit, daemon):
    page = visit(daemon).open()
    shown = page.evaluate("""async () => {
        const { Gauges } = await import("/page/gauges.js");
        const gauges = new Gauges(document.createElement("div"));
        return [0.7999, 0.8, 0.9499, 0.95, 1].map((fraction) => {
            gauges.show([{ cap: "x", fraction, value: fraction, limit: 1, unit: "W", pixel: null }]);
            const { item, level } = gauges.gauges.get("x");
            return [item.dataset.kind, level.textContent];
        });
    }""")
    warn, bad = ["warn", "▲ ≥ 80 %"], ["bad", "▲ ≥ 95 %"]
    assert shown == [["", ""], warn, warn, bad, bad]
    arm(page)
    train = long_train(seconds=10.0)
    train["trains"][0] |= {"pulse_width_s": 0.040, "gap_s": 0.001, "power_w": 2.4}
    daemon.call("POST", "/v1/plans", json=train)
    expect(page.locator(".gauge", has_text="mean power, one pixel")).to_have_attribute(
        "data-kind", re.compile("warn|bad")
    )
