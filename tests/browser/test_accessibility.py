"""The page by keyboard and screen reader: all of its states for axe-core, all actions by keys, and what is said."""

import os
import re
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest
from playwright.sync_api import expect

from forked_process import LONG_INDICATOR
from page_bench import INTERLOCK, SAFE_INPUTS
from rig import long_train, wait_for
from window import PHONE, WIDE, list_violations, play_for

LISTEN = """() => {
    window.heard = [];
    const say = (text, how) => text && window.heard.push([how, text.replace(/\\s+/g, " ").trim()]);
    for (const region of document.querySelectorAll("[role=log], [aria-live]")) {
        const how = region.getAttribute("aria-live") === "assertive" ? "at once" : "in turn";
        const onAdded = (changes) => changes.flatMap((change) => [...change.addedNodes])
            .forEach((node) => say(node.textContent, how));
        new MutationObserver(onAdded).observe(region, { childList: true });
    }
    for (const region of document.querySelectorAll("[role=alert], [role=status]")) {
        const how = region.getAttribute("role") === "alert" ? "at once" : "in turn";
        let last = "";
        const onChanged = () => {
            const text = region.hidden ? "" : region.textContent;
            if (text !== last) {
                say(text, how);
            }
            last = text;
        };
        const all = { childList: true, characterData: true, subtree: true, attributes: true };
        new MutationObserver(onChanged).observe(region, all);
    }
}"""
"""Note what a screen reader says by itself: additions to logs, and alerts and status texts that change or appear."""


@pytest.fixture
def heard(page):
    """Return a function that waits until texts of a pattern were said, and returns how each of them was."""
    page.evaluate(LISTEN)

    def wait_until_said(pattern):
        return wait_for(lambda: [how for how, text in read_heard(page) if re.search(pattern, text)], f"{pattern} said")

    return wait_until_said


def read_heard(page):
    """Return what was said so far, as pairs of how and text."""
    return page.evaluate("window.heard")


def read_focus(page):
    return page.evaluate("document.activeElement.id")


def go_to(page, name):
    """Move the focus with Tab alone to the control with this id. The page is a ring of controls."""
    start = page.evaluate("document.activeElement")
    for _ in range(100):
        if read_focus(page) == name:
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"Tab does not reach {name} from {start}")


def press(page, name, key="Enter"):
    go_to(page, name)
    page.keyboard.press(key)


LIST_CONTROLS = """() => {
    const all = "a[href], button, input, select, summary, [tabindex='0']";
    const controls = [...document.querySelectorAll(all)].filter((control) => {
        const other = control.type === "radio" && !control.checked;  // one stop per group, arrow keys within it
        return control.checkVisibility({ visibilityProperty: true }) && !control.matches(":disabled") && !other;
    });
    const name = (control) => control.id || control.textContent || control.name;
    return controls.map((control, k) => (control.dataset.stop = `${k} ${name(control)}`));
}"""


@pytest.mark.parametrize("key", ["Tab", "Shift+Tab"])
def test_tab_reaches_every_control_and_the_focus_is_seen(page, daemon, key):
    daemon.arm()
    play_for(daemon, 20.0)
    play_for(daemon, 2.0)
    expect(page.locator("#queue li")).to_have_count(1)
    page.get_by_text("Options", exact=True).click()
    for source in ("Draw", "Library"):
        page.get_by_text(source, exact=True).click()
        page.locator("#playing-title").focus()
        controls = set(page.evaluate(LIST_CONTROLS))
        assert len(controls) > 20
        reached = set()
        for _ in range(2 * len(controls)):
            page.keyboard.press(key)
            stop, outline, is_in_window = page.evaluate("""() => {
                const element = document.activeElement;
                const seen = element.matches("label input") && !getComputedStyle(element).appearance.includes("auto")
                    ? element.nextElementSibling ?? element : element;
                const box = element.getBoundingClientRect();
                const styles = [element, seen].map((each) => getComputedStyle(each));
                const outline = styles.some((style) => style.outlineStyle !== "none" && style.outlineWidth !== "0px");
                return [element.dataset.stop, outline, box.bottom > 0 && box.top < innerHeight];
            }""")
            if stop is not None:
                reached.add(stop)
                assert outline, f"no focus is seen on {stop}"
                assert is_in_window, f"{stop} is outside the window"
        assert reached == controls


def test_every_action_works_by_keys_alone(page, daemon, heard):
    page.locator("#display").focus()
    page.keyboard.press("Space")
    page.keyboard.press("ArrowUp")
    assert heard(r"^Pixel \d+: .* row \d+ of \d+, column \d+ of \d+$") == ["in turn"] * 2
    press(page, "clear")
    expect(page.locator("#drawn")).to_have_text("nothing drawn")
    page.keyboard.press("Shift+Tab")  # the tool, above it
    page.keyboard.press("ArrowLeft")
    assert page.locator('input[value="lower"]').is_checked()
    page.locator('input[value="draw"]').focus()
    page.keyboard.press("ArrowRight")
    press(page, "pattern", "v")
    page.keyboard.type("ibration")
    expect(page.locator("#pattern")).to_have_value("vibration")
    page.get_by_label("seconds, s").focus()
    page.keyboard.press("Control+A")
    page.keyboard.type("20")
    press(page, "preview")
    heard("All of it fits")
    assert read_focus(page) == "preview"
    press(page, "arm")
    heard("press the button Confirm within five seconds")
    press(page, "confirm-arm")
    heard("^Board: ARMED, ")
    press(page, "play")
    heard("^Sent: p")
    heard("^Board: RUNNING, the laser emits$")
    assert read_focus(page) == "play"
    waiting = play_for(daemon, 2.0)
    go_to(page, "queue")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    heard(f"^{waiting} is cancelled")
    expect(page.locator("#queue")).to_be_hidden()
    assert read_focus(page) == "playing-title"
    press(page, "pause", "Space")
    heard("^Paused: the laser is off")
    press(page, "pause", "Space")
    heard("^Resumed")
    press(page, "end")
    heard("cancelled")
    press(page, "disarm")
    heard("^Board: DISARMED, the laser is off$")
    press(page, "dim", "PageDown")
    heard("^Maximum power 90 %")
    press(page, "theme")
    expect(page.locator("#theme")).to_have_text("Theme: light")
    press(page, "stop")
    assert heard("^STOP is done: the laser is off") == ["at once"]
    page.keyboard.press("Escape")
    wait_for(lambda: len(heard("^STOP is done")) == 2, "STOP by the key to be said, too")


def is_said(page, how, beginning):
    return any(each == how and text.startswith(beginning) for each, text in read_heard(page))


def test_a_fault_its_cause_and_its_end_are_said_and_the_focus_is_kept(kept_window, bench):
    bench.replace_board(script=INTERLOCK)
    kept_window.reset()
    page = kept_window.page
    page.evaluate(LISTEN)
    bench.daemon.arm()
    play_for(bench.daemon, 8.0)
    for expected in (
        ("at once", "Fault: INTERLOCK"),
        ("in turn", "Board: FAULT, INTERLOCK"),
    ):
        wait_for(lambda expected=expected: is_said(page, *expected), expected[1])
    wait_for(lambda: bench.daemon.state()["board"]["inputs"] == SAFE_INPUTS, "it closes")
    wait_for(lambda: is_said(page, "in turn", "Interlock closed"), "the lamp")
    press(page, "acknowledge")
    wait_for(lambda: is_said(page, "in turn", "Board: DISARMED, the laser is off"), "the end")
    assert read_focus(page) == "laser-title"


def check_with_axe(page, axe):
    for scheme, viewport in (("light", WIDE), ("dark", PHONE), ("light", PHONE), ("dark", WIDE)):
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size(viewport)
        assert list_violations(page, axe) == [], (scheme, viewport)


def preview(page, pattern, **values):
    page.get_by_text("Library", exact=True).click()
    page.locator("#pattern").select_option(pattern)
    for name, value in values.items():
        page.locator("#parameters").get_by_label(name).fill(str(value))
    page.get_by_role("button", name="Preview").click()


def test_axe_finds_nothing_in_a_preview_that_is_refused_trimmed_or_fits(page, daemon, axe):
    preview(page, "text")
    expect(page.locator("#result .bad")).to_be_visible()
    check_with_axe(page, axe)
    page.get_by_label("text (required)").fill("hello")
    page.get_by_role("button", name="Preview").click()
    expect(page.locator("#result .good")).to_be_visible()
    check_with_axe(page, axe)
    preview(page, "checker", height=900)
    expect(page.locator("#result .warn, #result .bad").first).to_be_visible()
    check_with_axe(page, axe)


def test_axe_finds_nothing_while_it_arms(bench, window, axe):
    bench.replace_board(program=LONG_INDICATOR)
    with ThreadPoolExecutor() as executor:
        executor.submit(bench.daemon.call, "POST", "/v1/arm")
        expect(window.page.locator('#bar[data-state="arming"]')).to_be_visible()
        check_with_axe(window.page, axe)
        bench.daemon.call("POST", "/v1/stop")


def test_axe_finds_nothing_while_caps_are_near(page, daemon, axe):
    daemon.arm()
    train = long_train(seconds=10.0)
    train["trains"][0] |= {"pulse_width_s": 0.040, "gap_s": 0.001, "power_w": 2.4}
    daemon.call("POST", "/v1/plans", json=train)
    expect(page.locator('.gauge[data-kind="warn"], .gauge[data-kind="bad"]').first).to_be_visible()
    check_with_axe(page, axe)


def test_axe_finds_nothing_while_the_daemon_does_not_answer(page, bench, axe):
    processes = [bench.daemon.process.pid, *bench.daemon.list_children()]
    for pid in processes:  # the supervisor first, which would restart the others
        os.kill(pid, signal.SIGSTOP)
    try:
        expect(page.locator("#board-state")).to_have_text("UNKNOWN")
        check_with_axe(page, axe)
        expect(page.locator("#link")).to_have_text("no daemon, trying again")
        check_with_axe(page, axe)
        page.keyboard.press("Escape")
        expect(page.locator("#stopping")).to_contain_text("not answered yet")
        check_with_axe(page, axe)
    finally:
        for pid in reversed(processes):
            os.kill(pid, signal.SIGCONT)
    expect(page.locator("#board-state")).to_have_text("DISARMED")
