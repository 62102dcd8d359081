"""Fingers and the page that stands on the web page: drawn, in words, and said once."""

import json
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
def reading(daemon):
    """Return a function that reports two resting fingers on a page that stands. Both end with the test."""
    daemon.arm()
    with ExitStack() as stack:
        stream = stack.enter_context(open_socket(daemon, "/v1/stream?standing=true"))
        stream.send(json.dumps({"frame": 0, "target_um": {str(pixel): 50.0 for pixel in PAGE}}))
        assert json.loads(stream.recv())["status"] == "planned"
        tracker = stack.enter_context(open_socket(daemon, "/v1/fingers"))
        yield lambda: tracker.send(build_report())


def report_until(report, find, what):
    def attempt():
        report()
        return find()

    return wait_for(attempt, what)


def test_fingers_and_page_are_shown_and_said_once(page, axe, heard, reading):  # noqa: F811
    lines = page.locator("#fingers li")
    report_until(
        reading, lambda: lines.count() == 2 and "pulses/s" in lines.nth(1).inner_text(), "two fingers in words"
    )
    assert "dot" in lines.first.inner_text()
    expect(page.locator("#standing")).to_have_text(f"A page of {len(PAGE)} dots stands.")
    report_until(reading, lambda: heard("A tracker reports the fingers"), "the tracker said")
    for size in (WIDE, PHONE):
        page.set_viewport_size(size)
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            report_until(reading, lambda: page.locator("#tracker").inner_text().startswith("A tracker"), "the tracker")
            assert list_violations(page, axe) == []
    assert set(heard("The tracker is lost")) == {"in turn"}
    expect(page.locator("#tracker")).to_have_text("The tracker is lost: the whole page is drawn in turn.")
    expect(lines).to_have_count(0)
    texts = [text for _, text in read_heard(page) if "tracker" in text]
    assert all(one != other for one, other in pairwise(texts))
