"""STOP by any key and over everything, and what the header says about the laser."""

import os
import re
import signal

import pytest
from playwright.sync_api import expect

from window import arm, play_for, press_escape

STOP = "**/v1/stop"


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


def test_stop_finds_a_connection_beside_six_visible_windows(visit, daemon):
    window = visit(daemon)
    pages = [window.open()]
    for _ in range(5):  # browsers allow six connections to one host
        pages.append(window.context.new_page())
        pages[-1].goto(daemon.url)
        expect(pages[-1].locator("#board-state")).to_have_text("DISARMED")
    daemon.arm()
    stops, failed = [], []
    pages[-1].on("request", lambda request: request.url.endswith("/v1/stop") and stops.append(request))
    pages[-1].on("requestfailed", lambda request: request.url.endswith("/v1/stop") and failed.append(request))
    pages[-1].keyboard.press("Escape")
    expect(pages[0].locator("#board-state")).to_have_text("DISARMED")
    expect(pages[-1].locator("#stopping")).to_be_hidden()
    assert (len(stops), failed) == (1, [])
    expect(pages[-1].locator("#link")).to_have_text("live")
    expect(pages[-1].locator("#fault-history")).to_have_text("None.")  # the pause of the telemetry is no fault


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
    processes = [daemon.process.pid, *daemon.list_children()]
    for pid in processes:  # the supervisor first, which would restart the others
        os.kill(pid, signal.SIGSTOP)
    expect(page.locator("#board-state")).to_have_text("UNKNOWN", timeout=2_900)  # before the connection counts as lost
    for panel in panels:
        expect(panel.locator(".stale-mark")).to_have_text(re.compile(r"^stale since \d\d:\d\d:\d\d$"))
    expect(page.locator("#idle")).to_contain_text("Unknown")
    for pid in reversed(processes):
        os.kill(pid, signal.SIGCONT)
    expect(page.locator("#board-state")).to_have_text("FAULT")
    for panel in panels:
        expect(panel.locator(".stale-mark")).to_be_hidden()


def test_without_a_link_the_boards_figures_and_the_budgets_are_stale(visit, make_board, make_daemon):
    board = make_board()
    page = visit(make_daemon(board)).open()
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    expect(page.locator("#gauges")).not_to_be_empty()
    board.stop()
    for name, is_stale in (("Board", True), ("Budgets", True), ("Playing", False)):
        mark = page.get_by_role("region", name=name, exact=True).locator(".stale-mark")
        expect(mark).to_be_visible() if is_stale else expect(mark).to_be_hidden()
    expect(page.locator("#link")).to_have_text("live")
