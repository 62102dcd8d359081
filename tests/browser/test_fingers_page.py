"""Fingers and the page that stands on the web page: drawn, in words, and said once."""

import json
import threading
from contextlib import ExitStack
from itertools import pairwise
from socket import create_connection

import pytest
from playwright.sync_api import expect
from websockets.sync.client import connect

from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config
from rig import TOKEN, wait_for
from test_accessibility import heard, read_heard  # noqa: F401 - a fixture
from window import PHONE, WIDE, list_violations

LAYOUT = build_pixel_layout(load_config().display)
PAGE = tuple(range(50, 400, 2))
PIXELS = (200, 290)
PERIOD_S = 0.02


def open_socket(daemon, path):
    link = create_connection(("127.0.0.1", daemon.client.base_url.port))
    headers = {"Authorization": f"Bearer {TOKEN}"}
    return connect(f"ws://127.0.0.1{path}", sock=link, additional_headers=headers, proxy=None, compression=None)


def build_report():
    fingers = [
        {"number": number, "x_m": float(LAYOUT.x_m[pixel]), "y_m": float(LAYOUT.y_m[pixel]), "radius_m": 0.005}
        for number, pixel in enumerate(PIXELS, 1)
    ]
    return json.dumps({"fingers": fingers, "age_s": 0.0})


@pytest.fixture
def lift(daemon):
    """Report two resting fingers on a page that stands, until the returned function is called or the test ends."""
    daemon.arm()
    ended = threading.Event()
    with ExitStack() as stack:
        stream = stack.enter_context(open_socket(daemon, "/v1/stream?standing=true"))
        stream.send(json.dumps({"frame": 0, "target_um": {str(pixel): 50.0 for pixel in PAGE}}))
        assert json.loads(stream.recv())["status"] == "planned"
        tracker = stack.enter_context(open_socket(daemon, "/v1/fingers"))

        def report():
            while not ended.wait(PERIOD_S):
                tracker.send(build_report())

        thread = threading.Thread(target=report)
        thread.start()
        try:
            yield ended.set
        finally:
            ended.set()
            thread.join()


def test_fingers_and_page_are_shown_and_said_once(page, axe, heard, lift):  # noqa: F811
    lines = page.locator("#fingers li")
    expect(lines.nth(1)).to_contain_text("pulses/s")
    assert "dot" in lines.first.inner_text()
    expect(page.locator("#standing")).to_have_text(f"A page of {len(PAGE)} dots stands.")
    heard("A tracker reports the fingers")
    playing = page.locator("#now .what")
    expect(playing).to_have_text("Streamed frames by armerSTOP ends them.")
    expect(page.locator("#end")).to_have_attribute("data-empty", "")
    expect(page.locator("#now progress")).not_to_be_visible()
    for size in (WIDE, PHONE):
        page.set_viewport_size(size)
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            expect(page.locator("#tracker")).to_contain_text("A tracker")
            assert list_violations(page, axe) == []
    lift()
    assert set(heard("The tracker is lost")) == {"in turn"}
    expect(page.locator("#tracker")).to_have_text("The tracker is lost: the whole page is drawn in turn.")
    expect(lines).to_have_count(0)
    texts = [text for _, text in read_heard(page) if "tracker" in text]
    assert all(one != other for one, other in pairwise(texts))


def test_fingers_are_unknown_and_not_shown_while_the_page_gets_no_data(page, lift):
    lines = page.locator("#fingers li")
    expect(lines).to_have_count(2)
    set_hidden(page, True)
    expect(page.locator("#tracker")).to_have_text("Unknown where fingers are: no data from the daemon.")
    expect(lines).to_have_count(0)
    expect(page.locator("#standing")).to_have_text("")
    set_hidden(page, False)
    expect(lines).to_have_count(2)


def set_hidden(page, is_hidden):
    """Let the page take its window for hidden, which closes its telemetry, or for visible."""
    page.evaluate(
        """(isHidden) => {
            Object.defineProperty(document, "hidden", { value: isHidden, configurable: true });
            document.dispatchEvent(new Event("visibilitychange"));
        }""",
        is_hidden,
    )


FLAP = """async () => {
    const { FingersView } = await import("/page/fingers.js");
    const grid = { pixels: 4, rows: 2, columns: 2 };
    const view = { grid, requestPaint() {}, redrawMarks() {} };
    const elements = {};
    const find = (id) => (elements[id] ??= document.createElement("div"));
    window.flapped = [];
    const fingers = new FingersView(find, view, 0.01, (text) => window.flapped.push(text));
    for (let k = 0; k < 200; k++) {
        fingers.showFingers({ tracker: k % 2 ? "seen" : "lost", fingers: [] });
    }
    window.again = () => fingers.showFingers({ tracker: "lost", fingers: [] });
    return window.flapped.length;
}"""
"""Let a tracker come and go 100 times at once, and stay. Return how often that was said."""


def test_a_tracker_that_comes_and_goes_is_said_when_it_stays(page):
    assert page.evaluate(FLAP) == 0
    assert wait_for(lambda: page.evaluate("window.flapped"), "its last state") == ["A tracker reports the fingers."]
    page.evaluate("window.again()")
    said = wait_for(lambda: page.evaluate("window.flapped.slice(1)"), "its end")
    assert said == ["The tracker is lost."]


def test_refreshes_of_a_page_are_no_waiting_plans(page, daemon, lift):
    page.evaluate("""() => {
        window.rows = 0;
        new MutationObserver(() => window.rows++).observe(document.getElementById("queue"), { childList: true });
    }""")
    begin = daemon.state()["totals"]["executed"]
    wait_for(lambda: daemon.state()["totals"]["executed"] > begin + 300, "some refreshes")
    expect(page.locator("#now .plan")).to_have_text("Streamed frames by armer")
    assert page.evaluate("window.rows") == 0
