"""Take screenshots of the page in Chromium, desktop and phone, light and dark, while a daemon plays a drawing."""

import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / folder) for folder in ("system", "browser")]

from rig import Board, Daemon, wait_for  # noqa: E402
from window import PHONE, WIDE, PageVisit, launch_chromium  # noqa: E402

OUT = ROOT / "docs" / "pictures"
HEART = ("..##.##..", ".#######.", ".#######.", "..#####..", "...###...", "....#....")
PULSES_IN = 200


def draw_heart(page):
    """Draw a heart in the middle of 21 × 21 pixels by clicks."""
    page.locator("#display").scroll_into_view_if_needed()
    box = page.locator("#display").bounding_box()
    for down, line in enumerate(HEART):
        for right, mark in enumerate(line):
            if mark == "#":
                page.mouse.click(
                    box["x"] + (right + 6.5) / 21 * box["width"], box["y"] + (down + 7.5) / 21 * box["height"]
                )


def take_screenshot(browser, daemon, name, viewport, scheme):
    """Draw, play and save a screenshot while the pulses are executed."""
    window = PageVisit(browser, daemon.url, viewport=viewport, color_scheme=scheme, device_scale_factor=1)
    page = window.open()
    draw_heart(page)
    page.locator("#rate").fill("6")
    page.locator("#seconds").fill("4")
    page.locator("#preview").click()
    page.locator("#play:enabled").wait_for()
    daemon.arm()
    page.locator("#play").click()
    page.get_by_text("Height", exact=True).click()
    page.evaluate("scrollTo(0, 0)")
    before = daemon.state()["totals"]["executed"]
    wait_for(lambda: daemon.state()["totals"]["executed"] > before + PULSES_IN, "light")
    page.screenshot(path=OUT / f"page-{name}-{scheme}.png")
    daemon.call("POST", "/v1/stop")
    wait_for(lambda: daemon.board_state() == "DISARMED", "DISARMED")
    window.context.close()
    print(f"written {OUT / f'page-{name}-{scheme}.png'}")


def main():
    OUT.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        board = Board(Path(folder))
        try:
            daemon = Daemon(Path(folder), board.port)
            try:
                with launch_chromium() as browser:
                    for name, viewport in (("desk", WIDE), ("phone", PHONE)):
                        for scheme in ("light", "dark"):
                            take_screenshot(browser, daemon, name, viewport, scheme)
            finally:
                daemon.stop()
        finally:
            board.stop()


if __name__ == "__main__":
    main()
