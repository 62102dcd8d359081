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


def test_planned_pulses_are_outlines_however_dense(page):
    """Planned pulses are outlines and executed ones are filled, whichever their density.

    The shares of the picture that are filled are measured at half the height of the pulses, before and after now, and
    at the edge.
    """
    shares = page.evaluate("""async () => {
        const { Timeline } = await import("/page/timeline.js");
        const canvas = document.createElement("canvas");
        canvas.style = "width: 500px; height: 100px";
        document.body.append(canvas);
        const timeline = new Timeline(canvas, document.createElement("p"), 1);
        const batch = (beginS) => {
            const row = Array.from({ length: 190 }, (_, k) => k);
            const fill = (value) => row.map(() => value);
            const start_s = row.map((k) => beginS + 0.005 * k);
            return { plan: `p${beginS}`, row, pixel: fill(1), start_s, width_s: fill(0.004), power_w: fill(1),
                trimmed_j: fill(0), reason: fill("") };
        };
        while (canvas.width !== Math.round(500 * devicePixelRatio)) { // its size is observed
            await new Promise(requestAnimationFrame);
        }
        timeline.addPulses({ board_s: 10, planned: [batch(10.03)], executed: [batch(9.03)] });
        timeline.paint();
        const base = 100 - 18;
        const one = document.createElement("canvas").getContext("2d");
        one.fillStyle = timeline.colour.executed;
        one.fillRect(0, 0, 1, 1);
        const ink = [...one.getImageData(0, 0, 1, 1).data].slice(0, 3);
        const share = (y, fromX) => {
            const { data } = canvas.getContext("2d").getImageData(fromX, y, 90, 1);
            const isNear = (a, b) => Math.abs(a - b) < 30;
            const isInk = (k) => data[4 * k + 3] > 100 && ink.every((value, c) => isNear(data[4 * k + c], value));
            return Array.from({ length: 90 }, (_, k) => isInk(k)).filter(Boolean).length / 90;
        };
        const top = Math.round(base - base / 1.2);
        const edge = Math.max(...[-1, 0, 1].map((dy) => share(top + dy, 405)));
        canvas.remove();
        return [share(base / 2, 305), share(base / 2, 405), edge];
    }""")
    executed, planned, edge = shares
    assert executed > 0.7
    assert planned == 0.0
    assert edge > 0.5


def test_quantities_are_short(page):
    shown = page.evaluate("""async () => {
        const { formatQuantity } = await import("/page/quantities.js");
        return [41.494, 8.1, 0.32, 0.0125, 2e-6, 0].map((value) => formatQuantity(value, "J"));
    }""")
    assert shown == ["41.5 J", "8.10 J", "320 mJ", "12.5 mJ", "2.00 µJ", "0 J"]
