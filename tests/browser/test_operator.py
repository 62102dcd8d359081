"""The page as an operator uses it beside a laser: STOP, states, plans, roles and history."""

from playwright.sync_api import expect

from test_page import arm

STOP = "**/v1/stop"


def press_escape(page):
    """Press Escape and wait until STOP, which it must send, has been answered."""
    with page.expect_response(STOP, timeout=5_000):
        page.keyboard.press("Escape")
    expect(page.locator("#stopping")).to_be_hidden()


def test_escape_is_stop_while_any_control_is_open(visit, daemon):
    page = visit(daemon).open()
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
                expect(page.locator("#board")).to_have_text("board: DISARMED")


def test_escape_is_stop_while_a_file_dialog_is_open(visit, daemon):
    page = visit(daemon).open()
    devtools = page.context.new_cdp_session(page)
    devtools.send("Page.setInterceptFileChooserDialog", {"enabled": True, "cancel": True})
    arm(page)
    with page.expect_response(STOP, timeout=5_000):
        page.locator("#picture").click()
    expect(page.locator("#board")).to_have_text("board: DISARMED")


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
