"""What is in view, and what its colours mean."""

import re

from playwright.sync_api import expect

from rig import long_train
from window import PHONE, WIDE, arm, play_for


def is_in_view(page, *items):
    """Return whether each item lies in the window as it is after loading, below the header."""
    assert page.evaluate("scrollY") == 0
    top = page.locator("#bar").bounding_box()["height"]
    boxes = [item.bounding_box() for item in items]
    return all(box["y"] >= top and box["y"] + box["height"] <= page.viewport_size["height"] for box in boxes)


def test_pulses_and_board_are_in_view_on_a_desktop(visit, daemon):
    page = visit(daemon, viewport=WIDE).open()
    panels = [page.get_by_role("region", name=name, exact=True) for name in ("Laser", "Budgets", "Board", "Pulses")]
    expect(page.locator("#figures dt")).not_to_have_count(0)
    expect(page.locator(".gauge")).not_to_have_count(0)
    assert is_in_view(page, *panels, page.get_by_role("button", name="Play", exact=True))
    page.locator("#display").focus()
    page.keyboard.press("Space")
    page.get_by_role("button", name="Preview").click()
    expect(page.locator("#picked")).to_contain_text("drawn 100 µm, predicted 100")
    daemon.arm()
    for seconds in (6.0, 2.0):
        play_for(daemon, seconds)
    expect(page.locator("#timeline-text")).to_contain_text("start within the next second")
    assert is_in_view(page, *panels)


def test_arm_and_confirm_are_in_view_on_a_phone(visit, daemon):
    page = visit(daemon, viewport=PHONE, has_touch=True).open()
    arming = page.get_by_role("button", name="Arm …")
    assert is_in_view(page, arming)
    arming.tap()
    assert is_in_view(page, arming, page.get_by_role("button", name="Confirm: arm the laser"))


def test_a_colour_means_the_same_height_all_the_time(visit, daemon):
    page = visit(daemon).open()
    top = page.locator("#legend-high")
    daemon.arm()
    for height_um in (30, 150):
        plan = daemon.call("POST", "/v1/patterns/checker", json={"height_um": height_um})["plan"]
        expect(page.locator("#summary")).to_contain_text("pixels above 1 µm")
        expect(top).to_have_text("≥ 200 µm")
        daemon.finished(plan)
    page.get_by_text("Options").click()
    page.get_by_text("100 µm", exact=True).click()
    expect(top).to_have_text("≥ 100 µm")
    page.reload()
    expect(top).to_have_text("≥ 100 µm")
    page.get_by_text("Temperature", exact=True).click()
    expect(top).to_have_text("≥ 400 °C")


def test_gauges_warn_from_80_and_95_percent(visit, daemon):
    page = visit(daemon).open()
    shown = page.evaluate("""async () => {
        const { Gauges } = await import("/page/gauges.js");
        const gauges = new Gauges(document.createElement("div"));
        return [0.7999, 0.8, 0.9499, 0.95, 1].map((fraction) => {
            gauges.show([{ cap: "x", fraction, value: fraction, limit: 1, unit: "W", pixel: null }]);
            const { item, level } = gauges.gauges.get("x");
            return [item.dataset.kind, level.textContent];
        });
    }""")
    warn, bad = ["warn", "▲ ≥ 80 %"], ["bad", "▲ ≥ 95 %"]
    assert shown == [["", ""], warn, warn, bad, bad]
    arm(page)
    train = long_train(seconds=10.0)
    train["trains"][0] |= {"pulse_width_s": 0.040, "gap_s": 0.001, "power_w": 2.4}
    daemon.call("POST", "/v1/plans", json=train)
    expect(page.locator(".gauge", has_text="mean power, one pixel")).to_have_attribute(
        "data-kind", re.compile("warn|bad")
    )


def test_planned_pulses_are_dropped_executed_ones_stay(visit, daemon):
    page = visit(daemon).open()
    shown = page.evaluate("""async () => {
        const { Timeline } = await import("/page/timeline.js");
        const text = document.createElement("p");
        const timeline = new Timeline(document.createElement("canvas"), text, 1);
        const batch = (start_s) => ({
            plan: "p1", row: [start_s], pixel: [1], start_s: [start_s], width_s: [0.01], power_w: [1],
            trimmed_j: [0], reason: [""],
        });
        timeline.addPulses({ board_s: 5, planned: [batch(5.9)], executed: [batch(4.5)] });
        const describe = () => (timeline.describe(), text.textContent);
        const before = describe();
        timeline.dropPlanned();
        return [before, describe()];
    }""")
    executed = "In the last 4 s 1 pulses were executed, none trimmed. "
    assert shown == [f"{executed}1 start within the next second.", executed]
