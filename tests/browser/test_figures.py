"""The heights, pulses and quantities that the page shows are those that were executed."""

import re

import pytest
from playwright.sync_api import expect

from rig import wait_for

BUMP_S = 0.2
"""Time from the start of a pulse until its bump has passed its peak for certain."""


def test_every_peak_of_the_executed_pulses_is_in_the_trace(page, daemon):
    """The trace has each bump, which is over in a tenth of a second, at five displays per second.

    The motion of the page is reduced. Displays that a busy computer has merged have the highest bump among theirs.
    """
    page.evaluate("""async () => {
        const { Trace } = await import("/page/trace.js");
        const add = Trace.prototype.add;
        window.added = [];
        Trace.prototype.add = function (boardS, peakUm, absorberC) {
            window.added.push([boardS, peakUm]);
            add.call(this, boardS, peakUm, absorberC);
        };
    }""")
    pixel = re.match(r"Pixel (\d+):", page.locator("#picked").inner_text()).group(1)
    daemon.arm()
    frames = [
        {"show_at_s": 0.4 * k, "duration_s": 0.4, "target_um": {pixel: height_um}}
        for k, height_um in enumerate((60, 150, 90, 120, 100))
    ]
    wait_for(lambda: page.evaluate("window.added.length"), "a display")
    done = daemon.finished(daemon.call("POST", "/v1/plans", json={"frames": frames})["plan"])
    peaks_um, start_s = done["executed_pulses"]["simulated_um"], done["executed_pulses"]["start_s"]
    assert len(peaks_um) == 5
    begin_s = [done["onset"]["board_s"] + each - start_s[0] for each in start_s]
    end_s = [each + BUMP_S for each in begin_s]
    wait_for(lambda: page.evaluate("window.added.at(-1)[0]") > end_s[-1], "the last bump in the trace")
    added = page.evaluate("window.added")
    for bump in range(5):
        first = next(k for k, (board_s, _) in enumerate(added) if board_s > begin_s[bump])
        last = next(k for k, (board_s, _) in enumerate(added) if board_s > end_s[bump])
        since_s, until_s = added[first - 1][0], added[last][0]
        inside = [k for k in range(5) if since_s <= begin_s[k] and end_s[k] <= until_s]
        touched = [k for k in range(5) if since_s < end_s[k] and begin_s[k] < until_s]
        shown_um = max(peak_um for _, peak_um in added[first : last + 1])
        assert any(
            shown_um == pytest.approx(peaks_um[k], rel=0.01)
            and peaks_um[k] >= max(peaks_um[i] for i in [bump, *inside])
            for k in touched
        ), (bump, peaks_um, added[first - 1 : last + 1])
    assert max(peak_um for _, peak_um in added) == pytest.approx(max(peaks_um), rel=0.01)
    expect(page.locator("#picked")).to_contain_text(f"peak {max(peaks_um):.1f} µm")


def test_a_colour_means_the_same_height_all_the_time(page, daemon):
    top = page.locator("#legend-high")
    for height_um in (30, 150):
        daemon.arm()
        targets_um = dict.fromkeys(map(str, range(0, 437, 7)), height_um)
        frames = [{"show_at_s": 0.3 * k, "duration_s": 0.3, "target_um": targets_um} for k in range(200)]
        daemon.call("POST", "/v1/plans", json={"frames": frames})  # longer than the page needs to show it
        expect(page.locator("#summary")).to_contain_text("pixels above 1 µm")
        expect(top).to_have_text("≥ 200 µm")
        daemon.call("POST", "/v1/stop")
    page.get_by_text("Options").click()
    page.get_by_text("100 µm", exact=True).click()
    expect(top).to_have_text("≥ 100 µm")
    page.reload()
    expect(top).to_have_text("≥ 100 µm")
    page.get_by_text("Temperature", exact=True).click()
    expect(top).to_have_text("≥ 400 °C")


def test_planned_pulses_are_dropped_executed_ones_stay(page):
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
    executed = "In the last 4 s 1 pulse was executed, none trimmed. "
    assert shown == [f"{executed}1 starts within the next second.", executed]


def test_quantities_are_short(page):
    shown = page.evaluate("""async () => {
        const { formatQuantity } = await import("/page/quantities.js");
        return [41.494, 8.1, 0.32, 0.0125, 2e-6, 0].map((value) => formatQuantity(value, "J"));
    }""")
    assert shown == ["41.5 J", "8.10 J", "320 mJ", "12.5 mJ", "2.00 µJ", "0 J"]
