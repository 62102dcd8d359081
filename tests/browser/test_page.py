"""The page against a real daemon and its simulated board, as someone at a browser uses it."""

import re
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import expect

from page_bench import Bench
from rig import TOKEN, long_train, wait_for
from window import PHONE, WIDE, PageVisit, arm, list_violations, play_for


def canvas_point(page, across, up):
    """A point of the display's canvas, shares of it from the bottom left."""
    page.locator("#display").scroll_into_view_if_needed()
    box = page.locator("#display").bounding_box()
    return box["x"] + box["width"] * across, box["y"] + box["height"] * (1 - up)


def draw_line(page):
    page.mouse.move(*canvas_point(page, 0.31, 0.52))
    page.mouse.down()
    page.mouse.move(*canvas_point(page, 0.69, 0.52), steps=10)
    page.mouse.up()
    expect(page.locator("#drawn")).to_have_text("9 drawn")


def preview(page):
    page.get_by_role("button", name="Preview").click()
    expect(page.get_by_role("button", name="Play")).to_be_enabled()


def test_draw_preview_arm_play_and_what_was_felt(window, page, daemon):
    page.emulate_media(reduced_motion="no-preference")
    page.reload()
    draw_line(page)
    play = page.get_by_role("button", name="Play")
    expect(play).to_be_disabled()
    preview(page)
    page.locator("#height").fill("120")
    expect(play).to_be_disabled()  # what was previewed is not what is drawn
    page.locator("#height").fill("100")
    preview(page)
    result = page.locator("#result")
    expect(result).to_contain_text("All of it fits.")
    expect(result).to_contain_text("9 pulses")
    expect(result).to_contain_text("100.0 µm of 100.0 µm requested")
    before = daemon.state()["totals"]
    arm(page)
    play.dblclick()
    expect(result).to_contain_text("9 of 9 pulses executed; highest")
    totals = daemon.state()["totals"]
    assert [totals[name] - before[name] for name in ("planned", "executed")] == [9, 9]
    highest_um = float(re.search(r"highest ([\d.]+) µm", result.inner_text()).group(1))
    assert highest_um == pytest.approx(100, rel=0.02)
    expect(page.locator("#timeline-text")).to_contain_text("9 pulses were executed, none trimmed")
    assert window.unexpected_errors() == []


def test_nothing_moves_from_preview_to_stop_and_play_shows_what_is_felt(page, daemon):
    draw_line(page)
    page.locator("#rate").fill("6")
    page.locator("#seconds").fill("20")
    page.evaluate("scrollTo(0, 0)")
    preview(page)
    expect(page.locator('input[name="show"][value="preview"]')).to_be_checked()
    play, result = page.get_by_role("button", name="Play", exact=True), page.locator("#result")
    tops = [play.bounding_box()["y"]]
    page.get_by_role("button", name="Arm …").click()
    tops.append(play.bounding_box()["y"])
    page.get_by_role("button", name="Confirm: arm the laser").click()
    expect(page.locator("#board-state")).to_have_text("ARMED")
    tops.append(play.bounding_box()["y"])
    play.click()
    expect(page.locator("#now .plan")).to_have_text(re.compile(r"^p\d+ drawing by armer$"))
    assert page.locator("progress:visible").count() == 1
    tops.append(play.bounding_box()["y"])
    assert is_in_view(page, play, result)
    expect(page.locator('input[name="show"][value="height"]')).to_be_checked()
    daemon.call("POST", "/v1/stop")
    expect(result).to_contain_text("highest")
    assert is_in_view(page, play, result)
    assert [*tops, play.bounding_box()["y"]] == [tops[0]] * 5


def test_keys_alone_draw_preview_and_arm(page, daemon):
    page.locator("#display").focus()
    page.keyboard.press("Space")
    for _ in range(3):
        page.keyboard.press("ArrowRight")
        page.keyboard.press("Enter")
    expect(page.locator("#drawn")).to_have_text("4 drawn")
    expect(page.locator("#said")).to_contain_text("drawn 100 µm")
    page.keyboard.press("Space")
    expect(page.locator("#drawn")).to_have_text("3 drawn")
    page.get_by_role("button", name="Arm …").focus()
    page.keyboard.press("Enter")
    page.keyboard.press("Enter")
    assert page.get_by_role("button", name="Confirm: arm the laser").is_visible()
    assert daemon.board_state() == "DISARMED"


def test_a_picture_lies_on_the_grid_and_the_display_shows_its_heights(page, tmp_path):
    picture = tmp_path / "half.png"
    image = Image.new("L", (210, 210), 0)
    image.paste(255, (0, 0, 105, 210))
    image.save(picture)
    page.locator("#picture").set_input_files(picture)
    drawn = page.locator("#drawn")
    expect(drawn).to_have_text(re.compile(r"\d+ drawn"))
    assert int(drawn.inner_text().split()[0]) in range(208, 232)
    preview(page)
    expect(page.locator("#result")).to_contain_text("100.0 µm requested")


def test_the_library_offers_every_pattern_with_its_parameters(page, daemon):
    page.get_by_text("Library", exact=True).click()
    known = {pattern["name"]: pattern for pattern in daemon.call("GET", "/v1/patterns")["patterns"]}
    offered = page.locator("#pattern option").all_inner_texts()
    assert offered == list(known)
    for name in ("text", "experiment-2", "image"):
        page.locator("#pattern").select_option(name)
        assert page.locator("#parameters label").count() == len(known[name]["parameters"])
    page.locator("#pattern").select_option("text")
    page.get_by_role("button", name="Preview").click()
    expect(page.locator("#result .bad")).to_contain_text("text")
    page.get_by_label("text (required)").fill("hello")
    preview(page)


def test_what_the_limiter_took_is_told_in_time_line_and_gauges(page, daemon):
    warnings = page.evaluate("""async () => {
        const { Gauges } = await import("/page/gauges.js");
        const gauges = new Gauges(document.createElement("div"));
        return [0.7999, 0.8, 0.9499, 0.95, 1].map((fraction) => {
            gauges.show([{ cap: "x", fraction, value: fraction, limit: 1, unit: "W", pixel: null }]);
            const { item, level } = gauges.gauges.get("x");
            return [item.dataset.kind, level.textContent];
        });
    }""")
    warn, bad = ["warn", "▲ ≥ 80 %"], ["bad", "▲ ≥ 95 %"]
    assert warnings == [["", ""], warn, warn, bad, bad]
    arm(page)
    train = long_train(seconds=10.0)
    train["trains"][0] |= {"pulse_width_s": 0.040, "gap_s": 0.001, "power_w": 2.4}
    planned = daemon.call("POST", "/v1/plans", json=train)
    assert planned["summary"]["trimmed"]["pulses"] > 0
    expect(page.locator("#timeline-text")).to_contain_text("of them trimmed (")
    gauge = page.locator(".gauge", has_text="mean power, one pixel")
    expect(gauge).to_have_attribute("data-kind", re.compile("warn|bad"))
    assert int(gauge.get_by_role("meter").get_attribute("aria-valuenow")) >= 80


@pytest.mark.slow
def test_frames_come_while_something_plays_on_1511_pixels(browser, tmp_path):
    bench = Bench(tmp_path, "display-1511")
    try:
        daemon, window = bench.daemon, PageVisit(browser, bench.daemon.url)
        page = window.open()
        daemon.arm()
        daemon.call("POST", "/v1/patterns/checker", json={"height_um": 60})
        canvas = page.locator("#display")

        def frames():
            return int(canvas.get_attribute("data-frames"))

        wait_for(lambda: daemon.state()["totals"]["executed"] > 50, "light")
        before = frames()
        wait_for(lambda: frames() > before + 20, "frames")
        expect(page.locator("#summary")).to_contain_text("pixels above 1 µm")
        assert window.unexpected_errors() == []
        window.context.close()
    finally:
        bench.stop()


PANELS = ["Laser", "Budgets", "Board", "Pulses"]


def is_in_view(page, *items):
    """Return whether each item lies in the window as it is after loading, below the header."""
    assert page.evaluate("scrollY") == 0
    top = page.locator("#bar").bounding_box()["height"]
    boxes = [item.bounding_box() for item in items]
    return all(box["y"] >= top and box["y"] + box["height"] <= page.viewport_size["height"] for box in boxes)


def list_out_of_view(page):
    """Return the scrolling, the header, the alert and the panels of PANELS that are out of view, else nothing.

    The panels are given by top, bottom and heading. All is read at one moment, because the page changes with the plan.
    """
    return page.evaluate(
        """titles => {
            const [bar, alert] = ["bar", "trouble"].map((id) => document.getElementById(id));
            const boxes = [...document.querySelectorAll(".panel")].map((panel) => {
                const { top, bottom } = panel.getBoundingClientRect();
                return [Math.round(top), Math.round(bottom), panel.querySelector("h2").textContent];
            });
            const header = bar.getBoundingClientRect().bottom;
            const shown = boxes.filter(([top, bottom, title]) => titles.includes(title));
            const covered = shown.filter(([top, bottom]) => top < header || bottom > innerHeight);
            return covered.length || scrollY ? [scrollY, header, alert.textContent, ...covered] : [];
        }""",
        PANELS,
    )


def test_pulses_and_board_are_in_view_on_a_desktop(page, daemon):
    expect(page.locator("#figures dt")).not_to_have_count(0)
    expect(page.locator(".gauge")).not_to_have_count(0)
    assert not list_out_of_view(page)
    assert is_in_view(page, page.get_by_role("button", name="Play", exact=True))
    page.locator("#display").focus()
    page.keyboard.press("Space")
    page.get_by_role("button", name="Preview").click()
    expect(page.locator("#picked")).to_contain_text("drawn 100 µm, predicted 100")
    daemon.arm()
    for seconds in (6.0, 2.0):
        play_for(daemon, seconds)
    expect(page.locator("#timeline-text")).to_contain_text("start within the next second")
    assert not list_out_of_view(page)
    # As high as wide figures, and the limiter's reasons for trimming, make them.
    for line, line_count in (("picked", 2), ("summary", 2), ("timeline-text", 3)):
        page.locator(f"#{line}").evaluate("(line, count) => line.style.minHeight = `${1.35 * count}em`", line_count)
    assert not list_out_of_view(page)


def test_arm_and_confirm_are_in_view_on_a_phone(page):
    page.set_viewport_size(PHONE)
    arming = page.get_by_role("button", name="Arm …")
    assert is_in_view(page, arming)
    arming.tap()
    assert is_in_view(page, arming, page.get_by_role("button", name="Confirm: arm the laser"))


def test_reduced_motion_asks_for_fewer_pictures(page):
    requested = []
    page.on("request", lambda request: requested.append(request.url))
    for motion, rate_hz in (("reduce", 5), ("no-preference", 30)):
        page.emulate_media(reduced_motion=motion)
        page.reload()
        page.get_by_text("live", exact=True).wait_for()
        (telemetry,) = [url for url in requested if "/v1/telemetry" in url]
        assert telemetry.endswith(f"?rate_hz={rate_hz}")
        requested.clear()
        assert page.locator("#beam").is_checked() == (motion == "no-preference")


SMALL = {"width": 360, "height": 740}
LOOKS = (("light", WIDE), ("dark", PHONE))
OTHER_LOOKS = (("dark", WIDE), ("light", PHONE), ("light", SMALL), ("dark", SMALL))


@pytest.mark.parametrize("looks", [LOOKS, pytest.param(OTHER_LOOKS, marks=pytest.mark.slow)])
def test_axe_finds_nothing_and_nothing_sticks_out(page, daemon, axe, looks):
    def check():
        for scheme, viewport in looks:
            page.emulate_media(color_scheme=scheme)
            page.set_viewport_size(viewport)
            assert list_violations(page, axe) == []
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")

    page.get_by_text("Options", exact=True).click()
    page.get_by_text("Library", exact=True).click()
    page.get_by_role("button", name="Arm …").click()
    check()
    page.get_by_text("Draw", exact=True).click()
    arm(page)
    check()
    for seconds in (20.0, 2.0):
        daemon.call("POST", "/v1/plans", json=long_train(seconds=seconds))
    expect(page.locator("#board-state")).to_have_text("RUNNING")
    expect(page.locator("#queue li")).to_have_count(1)
    check()


def test_the_token_is_asked_for(visit, daemon, axe):
    window = visit()
    page = window.page
    page.goto(daemon.url)
    assert list_violations(page, axe) == []
    page.get_by_label("Token of this daemon").fill("a-wrong-token")
    page.get_by_role("button", name="Open").click()
    expect(page.get_by_role("alert")).to_contain_text("not the token")
    page.get_by_label("Token of this daemon").fill(TOKEN)
    page.keyboard.press("Enter")
    expect(page.locator("#link")).to_have_text("live")
    cookie = window.context.cookies()[0]
    assert (cookie["sameSite"], cookie["name"]) == ("Strict", f"optodrive-{daemon.client.base_url.port}")
    assert TOKEN not in page.url
    window.context.clear_cookies()
    page.goto(f"{daemon.url}/")
    page.get_by_label("Token of this daemon").wait_for()
    window.open()  # an address that differs only in its hash does not load the page anew


def test_a_browser_that_keeps_no_cookie_is_told_so(visit, daemon):
    page = visit().page
    page.add_init_script("Object.defineProperty(Document.prototype, 'cookie', {set() {}, get: () => ''})")
    page.goto(f"{daemon.url}/#token={TOKEN}")
    expect(page.get_by_role("alert")).to_contain_text("keeps no cookie")


def test_a_cookie_that_is_put_away_late_is_waited_for_and_no_token_is_in_the_history(visit):
    window = visit()
    window.page.add_init_script("""
        const cookie = Object.getOwnPropertyDescriptor(Document.prototype, "cookie");
        const late = function (text) { setTimeout(() => cookie.set.call(this, text), 300); };
        Object.defineProperty(Document.prototype, "cookie", { ...cookie, set: late });
    """)
    page = window.open()
    assert TOKEN not in page.url
    assert page.evaluate("history.length") <= 2


def test_every_script_of_the_page_is_ours_or_has_its_licence():
    folder = Path(__file__).parents[2] / "optodrive" / "daemon" / "page" / "vendor"
    for package in folder.iterdir():
        assert (package / "LICENSE").read_text().strip()
