"""Chromium on a daemon's page, for the browser tests, the pictures and the benchmark."""

import os
import shutil
from contextlib import contextmanager

from rig import TOKEN, long_train

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
TIMEOUT_MS = 500_000
"""Limit of last resort, shorter than that of pytest: its error shows the page."""
WIDE, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}


@contextmanager
def launch_chromium():
    """Launch a headless browser with a new profile, so that runs do not affect each other."""
    assert CHROMIUM, "the page is tested in Chromium, which is missing: apt-get install chromium"
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS), headless=True)
        try:
            yield browser
        finally:
            browser.close()


class PageVisit:
    """A window on a daemon's page that records the page's console errors."""

    def __init__(self, browser, url, viewport=WIDE, **options):
        self.context = browser.new_context(viewport=viewport, **options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(TIMEOUT_MS)
        self.console_errors = []
        self.page.on(
            "console", lambda line: line.type in ("error", "warning") and self.console_errors.append(line.text)
        )
        self.page.on("pageerror", lambda error: self.console_errors.append(str(error)))
        self.url = url

    def open(self, token=TOKEN):
        """Log in with the address that a terminal shows. Return the page once it is live."""
        self.page.goto(f"{self.url}/#token={token}")
        try:
            self.page.get_by_text("live", exact=True).wait_for()
        except Exception as error:
            raise AssertionError(
                f"the page did not come to life: {self.page.inner_text('body')[:500]!r} {self.console_errors}"
            ) from error
        return self.page

    def reset(self, token=TOKEN):
        """Load the page anew with a token, as if this browser had never been here. Its motion is reduced."""
        self.page.unroute_all()
        self.page.set_viewport_size(WIDE)
        self.page.emulate_media(color_scheme="light", reduced_motion="reduce")
        if self.page.url.startswith(self.url):
            self.page.evaluate("Storage.prototype.setItem = () => {}; sessionStorage.clear(); localStorage.clear()")
        self.sign_in(token)
        self.console_errors.clear()

    def sign_in(self, token):
        """Load the page with the cookie that a login leaves."""
        name = f"optodrive-{self.url.rpartition(':')[2]}"
        self.context.clear_cookies()
        self.context.add_cookies([{"name": name, "value": token, "url": self.url, "sameSite": "Strict"}])
        self.page.goto(self.url)
        self.page.get_by_text("live", exact=True).wait_for()

    def unexpected_errors(self, *expected):
        """Return the console errors except the expected ones. The 401 of the login is always expected."""
        expected = ("401", *expected)
        return [line for line in self.console_errors if not any(part in line for part in expected)]


def arm(page):
    """Arm with the two buttons."""
    page.get_by_role("button", name="Arm …").click()
    page.get_by_role("button", name="Confirm: arm the laser").click()
    page.locator("#board-state").get_by_text("ARMED", exact=True).wait_for()


def press_escape(page):
    """Press Escape and wait until STOP, which it must send, has been answered."""
    with page.expect_response("**/v1/stop"):
        page.keyboard.press("Escape")
    page.locator("#stopping").wait_for(state="hidden")


def list_violations(page, axe, within="html"):
    """Return the violations that axe-core finds in a part of the page."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(axe)
    return page.evaluate(
        """async (within) => {
            const { violations } = await axe.run(within, { resultTypes: ["violations"] });
            return violations.map(({ id, nodes }) => `${id}: ${nodes.map((node) => node.html.slice(0, 120))}`);
        }""",
        within,
    )


def play_for(daemon, seconds):
    """Submit a train of pulses and return its plan."""
    return daemon.call("POST", "/v1/plans", json=long_train(seconds=seconds))["plan"]
