"""The page against a real daemon and its simulated board, as someone at a browser uses it."""

import re
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import expect

from rig import TOKEN, long_train, wait_for
from window import INTERLOCK, PHONE, WIDE, arm


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


def start_long_pattern(page):
    """Something that runs for seconds, from the library."""
    page.get_by_text("Library", exact=True).click()
    page.locator("#pattern").select_option("vibration")
    page.get_by_label("seconds, s").fill("20")
    preview(page)
    page.get_by_role("button", name="Play").click()
    expect(page.locator("#board-state")).to_have_text("RUNNING")


def test_draw_preview_arm_play_and_what_was_felt(visit, daemon):
    window = visit(daemon)
    page = window.open()
    draw_line(page)
    expect(page.get_by_role("button", name="Play")).to_be_disabled()
    preview(page)
    result = page.locator("#result")
    expect(result).to_contain_text("All of it fits.")
    expect(result).to_contain_text("9 pulses")
    expect(result).to_contain_text("100.0 µm of 100.0 µm requested")
    before = daemon.state()["totals"]
    arm(page)
    page.get_by_role("button", name="Play").dblclick()
    expect(result).to_contain_text("9 of 9 pulses executed; highest")
    totals = daemon.state()["totals"]
    assert [totals[name] - before[name] for name in ("planned", "executed")] == [9, 9]
    highest_um = float(re.search(r"highest ([\d.]+) µm", result.inner_text()).group(1))
    assert highest_um == pytest.approx(100, rel=0.02)
    expect(page.locator("#timeline-text")).to_contain_text("9 pulses were executed, none trimmed")
    assert window.unexpected_errors() == []


def test_what_is_changed_after_the_preview_cannot_be_played(visit, daemon):
    page = visit(daemon).open()
    draw_line(page)
    preview(page)
    page.locator("#height").fill("120")
    expect(page.get_by_role("button", name="Play")).to_be_disabled()


def test_arming_takes_a_second_control_within_five_seconds(visit, daemon):
    page = visit(daemon).open()
    page.get_by_role("button", name="Arm …").click()
    confirm = page.get_by_role("button", name="Confirm: arm the laser")
    expect(confirm).to_be_visible()
    expect(confirm).to_be_hidden()
    expect(page.locator("#said")).to_have_text("Not armed.")
    assert daemon.board_state() == "DISARMED"


@pytest.mark.parametrize("how", ["button", "key"])
def test_stop_ends_what_plays(visit, daemon, board, how):
    page = visit(daemon).open()
    arm(page)
    start_long_pattern(page)
    wait_for(lambda: board.of("pulse"), "light")
    if how == "key":
        page.locator("#height, #pattern").locator("visible=true").first.focus()
        page.keyboard.press("Escape")
    else:
        page.get_by_role("button", name="STOP").click()
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    assert board.of("gate")[-1]["on"] is False
    expect(page.locator("#result")).to_contain_text("failed: ended by stop")


def test_stop_works_without_telemetry_and_is_sent_again_until_it_is_answered(visit, daemon):
    window = visit(daemon)
    page = window.open()
    arm(page)
    lost = []

    def lose(route):
        lost.append(route)
        if len(lost) <= 3:
            route.abort()
        else:
            route.continue_()

    page.route("**/v1/telemetry*", lambda route: route.abort())
    page.route("**/v1/stop", lose)
    page.keyboard.press("Escape")
    expect(page.locator("#stopping")).to_contain_text("not answered yet")
    expect(page.locator("#stopping")).to_be_hidden()
    assert len(lost) == 4
    assert daemon.board_state() == "DISARMED"


def test_an_open_interlock_is_said_in_words_and_acknowledged(visit, make_board, make_daemon):
    board = make_board(script=INTERLOCK)
    daemon = make_daemon(board)
    window = visit(daemon)
    page = window.open()
    arm(page)
    start_long_pattern(page)
    trouble = page.get_by_role("alert").filter(has_text="Fault: INTERLOCK")
    expect(trouble).to_contain_text("close the enclosure")
    expect(page.locator("#board-state")).to_have_text("FAULT")
    wait_for(lambda: len(board.of("input")) == 2, "it closes")
    page.get_by_role("button", name="Acknowledge").click()
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    expect(trouble).to_be_hidden()
    arm(page)
    assert window.unexpected_errors() == []


def test_a_daemon_started_anew_is_found_again_and_not_armed(visit, make_board, make_daemon):
    board = make_board()
    first = make_daemon(board)
    port = first.client.base_url.port
    window = visit(first)
    page = window.open()
    arm(page)
    first.stop()
    expect(page.locator("#link")).to_have_text("no daemon, trying again")
    expect(page.locator("#stale")).to_be_visible()
    second = make_daemon(board, options=("--port", str(port)))
    expect(page.locator("#link")).to_have_text("live")
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    expect(page.locator("#stale")).to_be_hidden()
    assert second.board_state() == "DISARMED"
    draw_line(page)
    preview(page)
    assert window.unexpected_errors("ERR_CONNECTION_REFUSED", "ERR_INCOMPLETE", "ERR_EMPTY") == []


def test_another_token_is_asked_for(visit, daemon, browser):
    window = visit(daemon)
    page = window.page
    page.goto(daemon.url)
    page.get_by_label("Token of this daemon").fill("a-wrong-token")
    page.get_by_role("button", name="Open").click()
    expect(page.get_by_role("alert")).to_contain_text("not the token")
    page.get_by_label("Token of this daemon").fill(TOKEN)
    page.keyboard.press("Enter")
    expect(page.locator("#link")).to_have_text("live")
    cookie = window.context.cookies()[0]
    assert (cookie["sameSite"], cookie["name"]) == ("Strict", f"optodrive-{daemon.client.base_url.port}")
    assert TOKEN not in page.url


def test_a_browser_that_keeps_no_cookie_is_told_so(visit, daemon):
    page = visit(daemon).page
    page.add_init_script("Object.defineProperty(Document.prototype, 'cookie', {set() {}, get: () => ''})")
    page.goto(f"{daemon.url}/#token={TOKEN}")
    expect(page.get_by_role("alert")).to_contain_text("keeps no cookie")


def test_a_cookie_that_is_put_away_late_is_waited_for(visit, daemon):
    window = visit(daemon)
    window.page.add_init_script("""
        const cookie = Object.getOwnPropertyDescriptor(Document.prototype, "cookie");
        const late = function (text) { setTimeout(() => cookie.set.call(this, text), 300); };
        Object.defineProperty(Document.prototype, "cookie", { ...cookie, set: late });
    """)
    window.open()


def test_the_address_may_come_when_the_token_is_asked_for_already(visit, daemon):
    window = visit(daemon)
    window.page.goto(f"{daemon.url}/")
    window.page.get_by_label("Token of this daemon").wait_for()
    window.open()


def test_a_terminals_address_leaves_no_token_in_the_history(visit, daemon):
    page = visit(daemon).open()
    assert TOKEN not in page.url
    assert page.evaluate("history.length") <= 2


def test_a_daemon_with_another_token_is_told_from_one_that_is_gone(visit, daemon):
    page = visit(daemon).open()
    page.route("**/v1/telemetry*", lambda route: route.fulfill(status=401))
    page.evaluate("Object.defineProperty(document, 'hidden', {configurable: true, value: true})")
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    page.evaluate("delete document.hidden")
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#trouble")).to_contain_text("another token")
    expect(page.get_by_role("link", name="Enter the new one")).to_be_visible()


def test_keys_alone_draw_preview_and_arm(visit, daemon):
    page = visit(daemon).open()
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


def test_a_picture_lies_on_the_grid_and_the_display_shows_its_heights(visit, daemon, tmp_path):
    page = visit(daemon).open()
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


def test_the_library_offers_every_pattern_with_its_parameters(visit, daemon):
    page = visit(daemon).open()
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


def test_what_the_limiter_took_is_told_in_preview_and_time_line(visit, daemon):
    page = visit(daemon).open()
    arm(page)
    train = long_train(seconds=3.0)
    train["trains"][0] |= {"pulse_width_s": 0.040, "gap_s": 0.001, "power_w": 2.4}
    planned = daemon.call("POST", "/v1/plans", json=train)
    assert planned["summary"]["trimmed"]["pulses"] > 0
    expect(page.locator("#timeline-text")).to_contain_text("of them trimmed (")
    gauge = page.get_by_role("meter", name="mean power, one pixel")
    wait_for(lambda: int(gauge.get_attribute("aria-valuenow")) > 60, "the gauge to rise")


def test_hidden_windows_leave_their_connection_to_others(visit, daemon):
    page = visit(daemon).open()
    page.evaluate("Object.defineProperty(document, 'hidden', {value: true})")
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#link")).not_to_have_text("live")
    page.keyboard.press("Escape")
    expect(page.locator("#stopping")).to_be_hidden()


@pytest.mark.slow
def test_frames_come_while_something_plays_on_1511_pixels(visit, make_board, make_daemon):
    daemon = make_daemon(make_board(), name="display-1511")
    window = visit(daemon)
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


@pytest.mark.parametrize(
    ("scheme", "viewport"),
    [
        ("light", WIDE),
        ("dark", PHONE),
        pytest.param("dark", WIDE, marks=pytest.mark.slow),
        pytest.param("light", PHONE, marks=pytest.mark.slow),
        pytest.param("light", {"width": 360, "height": 740}, marks=pytest.mark.slow),
        pytest.param("dark", {"width": 360, "height": 740}, marks=pytest.mark.slow),
    ],
)
def test_axe_finds_nothing_and_nothing_sticks_out(visit, daemon, axe, scheme, viewport):
    page = visit(daemon, color_scheme=scheme, viewport=viewport).open()
    page.evaluate(axe)
    page.get_by_text("Options", exact=True).click()
    for source in ("Draw", "Library"):
        page.get_by_text(source, exact=True).click()
        page.get_by_role("button", name="Arm …").click()
        assert list_violations(page) == []
    arm(page)
    assert list_violations(page) == []
    for seconds in (8.0, 2.0):
        daemon.call("POST", "/v1/plans", json=long_train(seconds=seconds))
    expect(page.locator("#board-state")).to_have_text("RUNNING")
    expect(page.locator("#queue li")).to_have_count(1)
    assert list_violations(page) == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def list_violations(page):
    found = page.evaluate("axe.run()")["violations"]
    return [f"{each['id']}: {[node['html'][:120] for node in each['nodes']]}" for each in found]


def test_axe_finds_nothing_on_a_fault_without_a_link(visit, make_board, make_daemon, axe):
    board = make_board(script=INTERLOCK)
    daemon = make_daemon(board)
    pages = [visit(daemon, color_scheme=scheme).open() for scheme in ("light", "dark")]
    daemon.arm()
    daemon.call("POST", "/v1/plans", json=long_train(seconds=8.0))
    for page in pages:
        expect(page.locator("#board-state")).to_have_text("FAULT")
        page.evaluate(axe)
        assert list_violations(page) == []
    board.stop()
    for page in pages:
        expect(page.get_by_role("region", name="Board").locator(".stale-mark")).to_be_visible()
        assert list_violations(page) == []


def test_axe_finds_nothing_where_the_token_is_asked_for(visit, daemon, axe):
    page = visit(daemon).page
    page.goto(daemon.url)
    page.evaluate(axe)
    assert list_violations(page) == []


def test_reduced_motion_asks_for_fewer_pictures(visit, daemon):
    page = visit(daemon, reduced_motion="reduce").page
    requested = []
    page.on("request", lambda request: requested.append(request.url))
    page.goto(f"{daemon.url}/#token={TOKEN}")
    page.get_by_text("live", exact=True).wait_for()
    assert any("rate_hz=5" in url for url in requested)
    assert not page.locator("#beam").is_checked()


def test_every_script_of_the_page_is_ours_or_has_its_licence():
    folder = Path(__file__).parents[2] / "optodrive" / "daemon" / "page" / "vendor"
    for package in folder.iterdir():
        assert (package / "LICENSE").read_text().strip()
