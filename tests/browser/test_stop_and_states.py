"""STOP by any key and over everything, and the page's words on the laser, faults and lost connections."""

import os
import re
import signal

import pytest
from playwright.sync_api import expect

from forked_process import FULL_INDICATOR
from page_bench import INTERLOCK, SAFE_INPUTS
from rig import wait_for
from window import arm, list_violations, play_for, press_escape

STOP = "**/v1/stop"


def start_long_pattern(page):
    """Something that runs for seconds, from the library."""
    page.get_by_text("Library", exact=True).click()
    page.locator("#pattern").select_option("vibration")
    page.get_by_label("seconds, s").fill("20")
    page.get_by_role("button", name="Preview").click()
    play = page.get_by_role("button", name="Play")
    expect(play).to_be_enabled()
    play.click()
    expect(page.locator("#board-state")).to_have_text("RUNNING")


@pytest.mark.parametrize("how", ["button", "key"])
def test_stop_ends_what_plays(page, bench, how):
    arm(page)
    start_long_pattern(page)
    wait_for(lambda: bench.board.of("pulse"), "light")
    if how == "key":
        page.locator("#height, #pattern").locator("visible=true").first.focus()
        page.keyboard.press("Escape")
    else:
        page.get_by_role("button", name="STOP").click()
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    assert bench.board.of("gate")[-1]["on"] is False
    expect(page.locator("#result")).to_contain_text("stopped (ended by stop).")
    entry = page.locator("#plan-history li").first
    expect(entry).to_contain_text("stopped (ended by stop)")
    assert entry.get_attribute("class") == ""  # a caller who stops it is no failure


def test_stop_works_without_telemetry_and_is_sent_again_until_it_is_answered(page, daemon):
    arm(page)
    sent, is_shown = [], False

    def lose(route):
        sent.append(route)
        if is_shown and len(sent) > 3:
            route.continue_()
        else:
            route.abort()

    page.route("**/v1/telemetry*", lambda route: route.abort())
    page.route(STOP, lose)
    page.keyboard.press("Escape")
    expect(page.locator("#stopping")).to_contain_text("not answered yet")
    is_shown = True
    expect(page.locator("#stopping")).to_be_hidden()
    assert len(sent) > 3
    assert daemon.board_state() == "DISARMED"


def test_escape_is_stop_while_any_control_is_open(page, daemon):
    page.get_by_text("Options").click()
    arm(page)
    for source, within in (("Draw", "main"), ("Library", "#library")):
        page.get_by_text(source, exact=True).click()
        if source == "Library":
            page.locator("#pattern").select_option("experiment-2")
        controls = page.locator("select, input:not([type=file]), button")
        controls = page.locator(within).locator(controls).locator("visible=true")
        assert controls.count() > 3
        for control in controls.element_handles():
            if control.is_visible() and control.is_enabled():
                control.click(force=True)  # the label of a radio button lies over it
                press_escape(page)
    expect(page.locator("#board-state")).to_have_text("DISARMED")


def test_what_the_browser_opens_itself_takes_no_escape_while_the_laser_may_emit(page):
    page.evaluate("addEventListener('contextmenu', (event) => (window.wasPrevented = event.defaultPrevented))")
    page.locator("#display").click(button="right")
    assert page.evaluate("window.wasPrevented") is False
    page.keyboard.press("Escape")
    arm(page)
    page.locator("#display").click(button="right")
    assert page.evaluate("window.wasPrevented") is True
    devtools = page.context.new_cdp_session(page)
    devtools.send("Page.setInterceptFileChooserDialog", {"enabled": True, "cancel": True})
    try:
        with page.expect_response(STOP):  # Escape in a file dialog
            page.locator("#picture").click()
    finally:
        devtools.detach()
    expect(page.locator("#board-state")).to_have_text("DISARMED")


def press_escape_once(page):
    """Press Escape. STOP must be answered at the first attempt, and the telemetry come back without a fault."""
    stops, failed = [], []
    page.on("request", lambda request: request.url.endswith("/v1/stop") and stops.append(request))
    page.on("requestfailed", lambda request: request.url.endswith("/v1/stop") and failed.append(request))
    page.keyboard.press("Escape")
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    expect(page.locator("#stopping")).to_be_hidden()
    assert (len(stops), failed) == (1, [])
    expect(page.locator("#link")).to_have_text("live")
    expect(page.locator("#fault-history")).to_have_text("None.")  # the pause of the telemetry is no fault


def test_stop_finds_a_connection_while_six_are_in_use(page, daemon):
    page.evaluate("""async () => {  // browsers allow six connections to one host, and the page itself has one
        const { request } = await import("/page/api.js");
        window.held = await Promise.all([1, 2, 3, 4, 5].map(() => request("GET", "/v1/telemetry?rate_hz=1")));
    }""")
    assert page.evaluate("window.held.map((response) => response.status)") == [200] * 5
    waits = page.evaluate("""async () => {
        const { request } = await import("/page/api.js");
        const signal = AbortSignal.timeout(300);
        return request("GET", "/v1/me", { signal }).then(() => "answered", (error) => error.name);
    }""")
    assert waits == "TimeoutError"
    daemon.arm()
    try:
        press_escape_once(page)
    finally:
        page.evaluate("window.held.forEach((response) => response.body.cancel())")


@pytest.mark.slow
def test_stop_finds_a_connection_beside_six_visible_windows(window, page, daemon):
    pages = [page]
    for _ in range(5):
        pages.append(window.context.new_page())
        pages[-1].goto(daemon.url)
        expect(pages[-1].locator("#board-state")).to_have_text("DISARMED")
    daemon.arm()
    press_escape_once(pages[-1])
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    for other in pages[1:]:
        other.close()


def set_hidden(page, is_hidden):
    page.evaluate("hidden => Object.defineProperty(document, 'hidden', {configurable: true, value: hidden})", is_hidden)
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")


def test_hidden_windows_leave_their_connection_to_others(page):
    set_hidden(page, True)
    expect(page.locator("#link")).not_to_have_text("live")
    press_escape(page)
    set_hidden(page, False)
    expect(page.locator("#link")).to_have_text("live")


def test_a_token_that_the_daemon_does_not_know_is_told_from_a_daemon_that_is_gone(page):
    page.route("**/v1/telemetry*", lambda route: route.fulfill(status=401))
    page.route(STOP, lambda route: route.fulfill(status=401))
    set_hidden(page, True)
    set_hidden(page, False)
    expect(page.locator("#trouble")).to_contain_text("does not know this page’s token")
    expect(page.get_by_role("link", name="Enter another one")).to_be_visible()
    expect(page.get_by_role("button", name="Arm …")).to_be_disabled()
    page.keyboard.press("Escape")
    expect(page.locator("#stopping")).to_contain_text("STOP was refused")


def read_look(page):
    """Return the features that distinguish a state in the header: word, outline of the sign, border pattern, ground."""
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


def test_disarmed_armed_and_running_differ_in_the_whole_header(page, daemon):
    state = page.locator("#board-state")
    looks = {"light": [], "dark": []}

    def look():
        for scheme, seen in looks.items():
            page.emulate_media(color_scheme=scheme)
            seen.append(read_look(page))

    expect(state).to_have_text("DISARMED")
    look()
    arm(page)
    look()
    play_for(daemon, 5.0)
    expect(state).to_have_text("RUNNING")
    look()
    expect(page).to_have_title(re.compile("^RUNNING · "))
    press_escape(page)
    expect(state).to_have_text("DISARMED")
    look()
    for *differing, again in looks.values():
        for what in ("word", "sign", "border", "ground"):
            assert len({seen[what] for seen in differing}) == 3, what
        assert again == differing[0]


def list_violations_in_both_schemes(page, axe):
    found = []
    for scheme in ("dark", "light"):
        page.emulate_media(color_scheme=scheme)
        found += list_violations(page, axe)
    return found


def test_an_open_interlock_is_said_in_words_acknowledged_and_kept_in_the_history(kept_window, bench, axe):
    bench.replace_board(script=INTERLOCK, program=FULL_INDICATOR)
    kept_window.reset()  # afterwards, so that the loss of the other board is not in the history
    page, board, daemon = kept_window.page, bench.board, bench.daemon
    faults = page.get_by_role("list", name="Faults").get_by_role("listitem")
    plans = page.get_by_role("list", name="Plans").get_by_role("listitem")
    expect(faults).to_have_text(["None."])
    page.evaluate("""() => {
        window.looks = [];
        const note = (changes) => window.looks.push(...changes.map((change) => change.oldValue));
        const observed = { attributes: true, attributeOldValue: true };
        new MutationObserver(note).observe(document.getElementById("bar"), observed);
    }""")
    arm(page)
    assert page.evaluate("window.looks") == ["off", "arming"]
    failed, waiting = play_for(daemon, 8.0), play_for(daemon, 1.0)
    trouble = page.locator("#trouble").filter(has_text="Fault: INTERLOCK")
    expect(trouble).to_contain_text("close the enclosure")
    expect(page.locator("#board-state")).to_have_text("FAULT")
    expect(faults).to_have_text([re.compile(r"^\d.*\d INTERLOCK: the interlock opened")])
    expect(plans.nth(0)).to_have_text(
        re.compile(rf"\d {waiting} push by armer: failed \(.*INTERLOCK.*\), 0 of 50 pulses$")
    )
    expect(plans.nth(1)).to_have_text(
        re.compile(rf"\d {failed} push by armer: failed \(.*INTERLOCK.*\), [1-9]\d* of 400 pulses$")
    )
    assert list_violations_in_both_schemes(page, axe) == []
    wait_for(lambda: len(board.of("input")) == 2, "it closes")
    wait_for(lambda: daemon.state()["board"]["inputs"] == SAFE_INPUTS, "the daemon to know")
    page.get_by_role("button", name="Acknowledge").click()
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    expect(trouble).to_be_hidden()
    expect(faults).to_have_count(2)
    arm(page)
    done = play_for(daemon, 0.2)
    expect(plans.first).to_have_text(re.compile(f"{done} push by armer: done, 10 of 10 pulses"))
    texts = [item.all_inner_texts() for item in (faults, plans)]
    page.reload()
    expect(page.locator("#figures dt")).not_to_have_count(0)  # the state event, which must add nothing
    assert [item.all_inner_texts() for item in (faults, plans)] == texts
    assert kept_window.unexpected_errors() == []


ESTOP_AND_KEY = """
[[step]]
from = "light"
at_s = 0.1
set = "estop"
value = true

[[step]]
from = "light"
at_s = 0.5
set = "key"
value = false
"""


def test_lamps_show_the_safety_inputs_and_the_header_the_fault(page, bench):
    bench.replace_board(script=ESTOP_AND_KEY)
    lamps = page.get_by_role("list", name="Safety inputs").get_by_role("listitem")
    expect(lamps).to_have_text(["Interlock closed", "Key on", "E-stop released"])
    bench.daemon.arm()
    play_for(bench.daemon, 5.0)
    expect(page.locator("#board-state")).to_have_text("FAULT")
    expect(page.locator("#board-means")).to_have_text("ESTOP")
    expect(lamps).to_have_text(["Interlock closed", "Key off", "E-stop pressed"])
    assert [lamp.get_attribute("data-kind") for lamp in lamps.all()] == ["safe", "unsafe", "unsafe"]


def test_a_link_that_goes_down_while_it_runs_shows_nothing_as_known(page, bench, axe):
    expect(page.locator("#gauges")).not_to_be_empty()
    bench.daemon.arm()
    play_for(bench.daemon, 10.0)
    expect(page.locator("#board-state")).to_have_text("RUNNING")
    bench.board.stop()
    expect(page.locator("#board-state")).to_have_text("UNKNOWN")
    expect(page.locator("#board-means")).to_have_text("no link to the board")
    expect(page.locator("#lamps")).to_have_text(re.compile("Interlock unknown.*Key unknown.*E-stop unknown"))
    state = bench.daemon.state()
    assert (state["link"]["state"], state["board"]["state"], state["board"]["fault"]) == ("down", "UNKNOWN", None)
    for name, is_stale in (("Board", True), ("Budgets", True), ("Playing", False)):
        mark = page.get_by_role("region", name=name, exact=True).locator(".stale-mark")
        expect(mark).to_be_visible() if is_stale else expect(mark).to_be_hidden()
    expect(page.locator("#link")).to_have_text("live")
    assert list_violations_in_both_schemes(page, axe) == []


def test_figures_that_stop_arriving_are_marked_as_stale(page, daemon):
    daemon.arm()
    play_for(daemon, 20.0)
    expect(page.locator("#board-state")).to_have_text("RUNNING")
    panels = [page.get_by_role("region", name=name) for name in ("Budgets", "Board", "Pulses", "Playing")]
    for panel in panels:
        expect(panel.locator(".stale-mark")).to_be_hidden()
    page.evaluate("""() => {
        const [state, link] = ["board-state", "link"].map((name) => document.getElementById(name));
        new MutationObserver(() => {
            if (state.textContent === "UNKNOWN") window.linkWhenUnknown ??= link.textContent;
        }).observe(state, { childList: true, characterData: true, subtree: true });
    }""")
    processes = [daemon.process.pid, *daemon.list_children()]
    for pid in processes:  # the supervisor first, which would restart the others
        os.kill(pid, signal.SIGSTOP)
    try:
        expect(page.locator("#board-state")).to_have_text("UNKNOWN")
        assert page.evaluate("window.linkWhenUnknown") == "live"  # before the connection counts as lost
        for panel in panels:
            expect(panel.locator(".stale-mark")).to_have_text(re.compile(r"^stale since \d\d:\d\d:\d\d$"))
        expect(page.locator("#idle")).to_contain_text("Unknown")
        expect(page.locator("#dim-value")).to_have_text("unknown")
        assert page.locator("#dim-value").evaluate("(value) => value.scrollWidth <= value.clientWidth"), "cut off"
    finally:
        for pid in reversed(processes):
            os.kill(pid, signal.SIGCONT)
    expect(page.locator("#board-state")).to_have_text("FAULT")
    for panel in panels:
        expect(panel.locator(".stale-mark")).to_be_hidden()


def test_a_daemon_started_anew_is_found_again_and_not_armed(window, page, bench):
    arm(page)
    bench.daemon.stop()
    expect(page.locator("#link")).to_have_text("no daemon, trying again")
    expect(page.locator("#stale")).to_be_visible()
    bench.restart_daemon()
    expect(page.locator("#link")).to_have_text("live")
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    expect(page.locator("#stale")).to_be_hidden()
    assert bench.daemon.board_state() == "DISARMED"
    page.locator("#display").focus()
    page.keyboard.press("Space")
    page.get_by_role("button", name="Preview").click()
    expect(page.get_by_role("button", name="Play")).to_be_enabled()
    assert window.unexpected_errors("ERR_CONNECTION_REFUSED", "ERR_INCOMPLETE", "ERR_EMPTY") == []
