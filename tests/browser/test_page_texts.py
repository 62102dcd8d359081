"""Every sentence of the page agrees with every other and with the telemetry, and alerts are heard one at a time.

The page's time is that of the test. The judge reads the texts alone, and shares nothing with the page.
"""

import re
from datetime import UTC, datetime

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, HeightTrain
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.plan_summary import summarize_plan
from text_world import CAPS, TextPage, World

STEPS = 25
UNASKED_MIN_MS = 2900
"""Shortest time between two announcements that nobody asked for."""
GENERIC = "The indicator is on for two seconds before the laser can emit."


def number(pattern, text):
    found = re.search(pattern, text)
    return None if found is None else float(found[1])


def judge(shown, world, page):
    """Return what disagrees in the texts of a page that knows a world's telemetry up to a second ago."""
    return [
        *judge_state(shown, world),
        *(judge_known(shown, world) if world.is_known else judge_unknown(shown)),
        *judge_fingers(shown, world),
        *judge_history(shown, world, page),
    ]


def judge_state(shown, world):
    word, state = shown["board-state"], world.reported_state
    expected = "PAUSED" if world.is_paused and state == "ARMED" else state
    if word != expected:
        yield f"the header says {word}, the telemetry {expected}"
    if not shown["title"].startswith(f"{word} · "):
        yield f"the title {shown['title']!r} beside {word}"
    if ("Fault: " in shown["trouble"]) != (word == "FAULT"):
        yield f"{shown['trouble']!r} beside {word}"
    if "No link" in shown["trouble"] and word != "UNKNOWN":
        yield f"{shown['trouble']!r} beside {word}"
    if ("emits." in shown["arming"]) != (word == "RUNNING"):
        yield f"{shown['arming']!r} beside {word}"
    if ("Paused" in shown["arming"]) != (word == "PAUSED"):
        yield f"{shown['arming']!r} beside {word}"
    if (word in ("DISARMED", "UNKNOWN")) != shown["arming"].startswith(GENERIC):
        yield f"{shown['arming']!r} beside {word}"
    if (word in ("ARMING", "ARMED", "RUNNING", "HOLD", "PAUSED")) != bool(shown["control"]):
        yield f"{shown['control']!r} beside {word}"
    for name, text in shown["stats"].items():
        if name.startswith("Stage") and word in ("UNKNOWN", "RUNNING", "DISARMED", "FAULT"):
            known = {"UNKNOWN": ("no link", "UNKNOWN")}.get(word, (word,))
            if not text.startswith(known):
                yield f"{name}: {text!r} beside {word}"


def judge_unknown(shown):
    """Nothing claims what the board does or did last."""
    for name in ("idle", "timeline-text", "summary"):
        if not shown[name].startswith("Unknown"):
            yield f"{name} says {shown[name]!r} while nothing is known"
    if "unknown" not in shown["picked"]:
        yield f"{shown['picked']!r} while nothing is known"
    for name in ("Laser on", "Underruns", "Board temperature"):
        if shown["stats"][name] != "–":
            yield f"{name} {shown['stats'][name]} while nothing is known"
    if shown["plan"] or shown["queue"]:
        yield f"{shown['plan']!r} {shown['queue']} play while nothing is known"
    if re.search(r"p\d+ (plays|waits)", shown["result"]):
        yield f"{shown['result']!r} while nothing is known"
    if not all("unknown" in lamp for lamp in shown["lamps"]):
        yield f"{shown['lamps']} while nothing is known"
    for name, is_hatched in shown["hatched"].items():
        if not is_hatched:
            yield f"the panel of {name} is not hatched while nothing is known"
    if not shown["stale"] or shown["look"] != "unknown":
        yield "the display looks live while nothing is known"


def judge_known(shown, world):
    yield from judge_plans(shown, world)
    yield from judge_pulses(shown, world)
    yield from judge_heights(shown, world)
    if any(shown["hatched"].values()) or shown["stale"]:
        yield f"hatched: {shown['hatched']} {shown['stale']!r} with figures that are new"
    if shown["stats"]["Laser on"] != f"{world.laser_on_s:.2f} s":
        yield f"Laser on {shown['stats']['Laser on']}, reported {world.laser_on_s:.2f}"
    minutes = {None: "", 59.0: "for 1 min: ", 700.0: "for 12 min: "}[world.hot_for_s if world.has_planner else None]
    expected = (
        f"{minutes}the display counts as hot, because the process that used it last was killed" if minutes else ""
    )
    if shown["stats"].get("Less light", "") != expected:
        yield f"less light {shown['stats'].get('Less light')!r}, expected {expected!r}"
    words = ("open", "closed") if not world.inputs & 1 else ("closed", "open")
    if shown["lamps"][0] != f"Interlock {words[0]}":
        yield f"{shown['lamps'][0]!r} of inputs {world.inputs}"


def judge_plans(shown, world):
    is_off = world.state in ("DISARMED", "FAULT")
    active = [] if is_off or not world.has_planner else world.active
    if not world.has_planner:
        if not shown["idle"].startswith("Unknown") or shown["stats"]["Pulses executed"] != "–" or shown["plan"]:
            yield f"{shown['idle']!r} {shown['plan']!r} {shown['stats']['Pulses executed']} without a planner"
        return
    if shown["stats"]["Pulses executed"] != str(world.total):
        yield f"{shown['stats']['Pulses executed']} pulses executed, reported {world.total}"
    first = active[0] if active and active[0].status in ("running", "paused") else None
    frames = active[0] if active and active[0].name.startswith("frame") else None
    if bool(shown["plan"]) != (first is not None or frames is not None):
        yield f"{shown['plan']!r} plays, reported {[plan.describe() for plan in active]}"
    if is_off and (shown["idle"] != "Nothing plays." or shown["queue"]):
        yield f"{shown['idle']!r} {shown['queue']} beside {world.state}"
    if world.state == "RUNNING" and shown["idle"] == "Nothing plays.":
        yield "RUNNING, and nothing plays"
    if first is not None and frames is None:
        if not shown["left"].startswith(f"{first.executed} of {first.planned} pulses, "):
            yield f"{shown['left']!r} of {first.executed} of {first.planned}"
        if shown["left"].endswith("paused") != (first.status == "paused"):
            yield f"{shown['left']!r} of a plan that is {first.status}"
    for plan in world.plans:
        entries = [text for text in shown["plans"] if f" {plan.id} " in text]
        for text in entries:
            if f": {plan.status}" not in text or f", {plan.executed} of {plan.planned} pulses" not in text:
                yield f"the history says {text!r} of {plan.describe()}"


def judge_pulses(shown, world):
    text = shown["timeline-text"]
    count = number(r"In the last 4 s (\d+) puls", text) or 0
    if (count == 0) != text.startswith("No pulse in the last 4 s."):
        yield f"{text!r}"
    begin_s = [pulse[2] for pulse in world.executed]
    certain = sum(world.board_s - 2.9 < each for each in begin_s)  # the text is up to a second old
    possible = sum(world.board_s - 4.01 < each for each in begin_s)
    if not certain <= count <= possible:
        yield f"{text!r}: {certain} to {possible} were executed"
    if world.has_planner and count > world.total:
        yield f"{text!r} beside {shown['stats']['Pulses executed']} pulses executed"
    trimmed = number(r"(\d+) of them trimmed", text) or 0
    if trimmed > sum(pulse[4] > 0 for pulse in world.executed if world.board_s - 4.01 < pulse[2]) or trimmed > count:
        yield f"{text!r}: more than were trimmed"
    is_dark = world.state not in ("ARMED", "RUNNING", "HOLD") or world.is_paused
    if "within the next second" in text and is_dark:
        yield f"{text!r} while the laser is off"
    if (number(r"(\d+) starts? within", text) or 0) > len(world.upcoming):
        yield f"{text!r}, announced {len(world.upcoming)}"


def judge_heights(shown, world):
    highest = re.search(
        r"(\d+) pixels? above 1 µm, highest ([\d.]+) µm at (\d+); .* ([\d.]+) °C at (\d+)", shown["summary"]
    )
    raised = int((np.round(world.peak, 1) > 1).sum())
    if (highest is None) != (raised == 0):
        yield f"{shown['summary']!r}: {raised} pixels"
        return
    pixel, now, peak, peak_c = (
        number(pattern, shown["picked"])
        for pattern in (r"Pixel (\d+):", r"now ([\d.]+) µm", r"peak ([\d.]+) µm", r"peak [\d.]+ µm, ([\d.]+) °C")
    )
    if pixel is None or now is None or peak is None:
        yield f"{shown['picked']!r}"
        return
    pixel = int(pixel)
    if abs(now - world.height[pixel]) > 0.051 or peak < now:
        yield f"{shown['picked']!r}, reported {world.height[pixel]} µm"
    if highest is not None:
        if int(highest[1]) != raised or abs(float(highest[2]) - world.peak.max()) > 0.051:
            yield f"{shown['summary']!r}: {raised} pixels, {world.peak.max()} µm"
        if int(highest[3]) == pixel and float(highest[2]) > peak + 0.001:
            yield f"{shown['summary']!r} beside {shown['picked']!r}"
        if peak > float(highest[2]) + 0.001 and "in 10 s" not in shown["picked"]:
            yield f"{shown['summary']!r} beside {shown['picked']!r}, without its time"
        if int(highest[5]) == pixel and float(highest[4]) > peak_c + 0.001:
            yield f"{shown['summary']!r} beside {shown['picked']!r}"


def judge_fingers(shown, world):
    dots = number(r"A page of (\d+) dots? stands", shown["standing"]) or 0
    if dots != len(world.page):
        yield f"{shown['standing']!r}: {len(world.page)} dots"
    named = re.findall(r"The cap “([^”]+)” takes light from it\.", shown["standing"])
    if named != [CAPS[cap] for cap in world.caps]:
        yield f"{shown['standing']!r}: limited by {world.caps}"
    if len(shown["fingers"]) != len(world.fingers):
        yield f"{shown['fingers']}: {len(world.fingers)} fingers"
    for line in shown["fingers"]:
        if (number(r": (\d+) dots?,", line) or 0) > dots:
            yield f"{line!r} beside {shown['standing']!r}"
    if "whole page" in shown["tracker"] and not dots:
        yield f"{shown['tracker']!r} beside {shown['standing']!r}"


def judge_history(shown, world, page):
    for text in shown["plans"]:
        plan = next((plan for plan in world.plans if f" {plan.id} " in text), None)
        if plan is not None and not plan.name.startswith("frame"):  # of a stream the time is that of its first frame
            began = datetime.fromtimestamp(page.now_s - plan.age_s, UTC)
            clock = datetime.strptime(text.split()[0], "%H:%M:%S").replace(tzinfo=UTC)
            apart_s = abs((clock - began.replace(year=1900, month=1, day=1)).total_seconds())
            if min(apart_s, 86400 - apart_s) > 2.5:
                yield f"{text!r} of a plan of {began:%H:%M:%S}"


def judge_announcements(heard):
    """Return the announcements that follow another one too soon; an alert waits for alerts only."""
    found, last_ms = [], {"alert": -1e9, "any": -1e9}
    for region, at_ms, text in heard:
        is_alert = region == "said-at-once"
        if at_ms - last_ms["alert" if is_alert else "any"] < UNASKED_MIN_MS:
            found.append(f"{text!r} too soon")
        last_ms["any"] = at_ms
        if is_alert:
            last_ms["alert"] = at_ms
    return found


def run_world(page, seed, steps=STEPS):
    """Let a world of this seed go on, and return the first disagreement and the steps before it."""
    world = World(seed)
    for step in range(steps):
        world.step()
        page.send(world.build_events())
        page.wait(1.0)
        found = judge(page.read(), world, page)
        if found:
            return f"seed {seed}, step {step}: " + "; ".join(found)
    return "; ".join(judge_announcements(page.read_heard()))


@pytest.fixture
def open_page(browser):
    pages = []

    def open_with(mutant=None):
        pages.append(TextPage(browser, mutant))
        return pages[-1]

    yield open_with
    for page in pages:
        page.close()


def mark_slow(values):
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


@pytest.mark.parametrize("seed", [*range(3), *mark_slow(range(3, 200))])
def test_all_texts_agree_whatever_happens(open_page, seed):
    assert run_world(open_page(), seed) == ""


class Desk:
    """A world that the test moves itself, and the page that reads of it."""

    def __init__(self, page):
        self.page, self.world = page, World(0)
        self.world.plans, self.world.number, self.world.stages = [], 0, 0

    def tell(self, seconds=1.0):
        self.page.send(self.world.build_events())
        self.page.wait(seconds)
        shown = self.page.read()
        assert [*judge(shown, self.world, self.page)] == []
        return shown

    def run(self, seconds=1.0):
        self.world.pass_second()
        return self.tell(seconds)

    def play(self, planned=40):
        """Let a plan of one pulse at 200 µm per step play on the selected pixel."""
        plan = self.world._add_plan()
        plan.name, plan.planned, self.world.state = "push", planned, "ARMED"
        return plan


@pytest.fixture
def desk(open_page):
    return Desk(open_page())


def test_executed_pulses_are_in_the_text_as_soon_as_they_are_reported(desk):
    desk.play(32)
    world = desk.world
    world.pass_second()
    world._execute(world.plans[0], 32 - world.plans[0].executed)
    world.state = "RUNNING"
    desk.page.send(world.build_events())
    shown = desk.page.read()  # before any second has passed
    assert shown["board-state"] == "RUNNING"
    assert "In the last 4 s 32 pulses were executed" in shown["timeline-text"]


def test_a_new_reader_whose_first_pulses_are_old_is_not_told_that_they_are_new(desk):
    world = desk.world
    world.fresh = [("p9", row, 10.0 + row, 3, 0.0) for row in range(3)]
    world.fresh_planned = []
    events = world.build_events().replace(f'"board_s": {world.board_s}, "planned"', '"board_s": 13.0, "planned"')
    desk.page.send(events)
    desk.page.wait(1.0)
    assert desk.page.read()["timeline-text"] == "No pulse in the last 4 s."


def test_a_fault_from_before_the_tab_has_no_time_of_its_own(desk):
    desk.world.state, desk.world.fault = "FAULT", "INTERLOCK"
    (first,) = desk.run()["faults"]
    assert re.match(r"before \d\d:\d\d:\d\d INTERLOCK", first)


def test_a_pause_and_a_board_ahead_of_the_planner_are_in_no_sentence_denied(desk):
    world = desk.world
    desk.play(1000)
    desk.run()
    world.fresh, world.fresh_planned = [], [("p1", 999, world.board_s + 1.9, 3, 0.0)]
    desk.page.send(world.build_events())
    world.fresh_planned, world.upcoming = [], []
    world.pause()
    desk.page.send(world.build_events())  # at once: what was announced does not come
    assert desk.page.read()["timeline-text"].startswith("In the last 4 s")
    assert "within the next second" not in desk.page.read()["timeline-text"]
    world.pause()
    world.state, world.plans[0].status = "RUNNING", "cancelled"  # the planner knows of the end first
    desk.page.send(world.build_events())
    assert desk.page.read()["idle"] == "Not reported yet: what plays."


SUMMARY = {
    "feasibility": None,
    "pulses": 187,
    "duration_s": 2.0,
    "energy_j": 0.5,
    "target_max_um": 100.0,
    "predicted_max_um": 99.0,
    "delays": [],
    "trimmed": {"pulses": 0, "by_reason": {}, "energy_j": 0.0},
    "off_target": {"count": 0, "trains": []},
    "repeats": None,
    "skipped": [
        {"frame": f"f{k}", "pixel": pixel, "target_um": 100.0, "reason": ""} for pixel in range(12) for k in range(9)
    ],
}


def test_pixels_that_get_some_pulses_are_not_said_to_need_none(desk):
    page = desk.page.page
    desk.run()
    pixels = [pixel for pixel in range(12) for _ in range(11)]  # 11 of 20 pulses each
    page.evaluate(
        "preview => (feed.preview = preview)",
        {"summary": SUMMARY, "pulses": {"pixel": pixels, "predicted_um": [99.0] * 132}},
    )
    page.locator("#display").press("Space")
    page.get_by_role("button", name="Preview").click()
    page.locator("#result .good").wait_for()
    text = page.locator("#result").inner_text()
    assert "108 targets on 12 pixels need no pulse: the heat left there is sufficient." in text


def test_the_preview_names_peaks_that_differ_from_the_height_of_their_train(desk):
    display = DISPLAYS["display-437"]
    trains = tuple(HeightTrain(200 + k, 0.2 * k, 0.1, 0.01, 380e-6) for k in range(5))
    plan = plan_sequence(display, FrameSequence(trains=trains), *display.build_cold_state())
    summary = summarize_plan(plan).model_dump(mode="json")
    page = desk.page.page
    desk.run()
    page.evaluate(
        "preview => (feed.preview = preview)", {"summary": summary, "pulses": {"pixel": [], "predicted_um": []}}
    )
    page.locator("#display").press("Space")
    page.get_by_role("button", name="Preview").click()
    page.locator("#result .warn").first.wait_for()
    text = page.locator("#result").inner_text()
    for number, train in enumerate(plan.train_peaks[:3]):
        first, second = 1e6 * train.peak_m[:2]
        begin = f" of 10 peaks of train {number} differ from 380 µm by more than 2 %: "
        assert f"{begin}{first:.1f} µm in cycle 1, {second:.1f} µm in cycle 2" in text
    assert "And peaks of 2 more trains differ." in text


def test_stop_without_an_answer_is_heard_once_at_once_and_then_every_few_seconds(desk):
    desk.run()
    page = desk.page.page
    page.evaluate("feed.answersStop = false; feed.isUp = false; feed.controller.error(new Error('gone'))")
    begin_ms = page.evaluate("performance.now()")
    page.keyboard.press("Escape")
    page.locator("#stopping").get_by_text("not answered yet").wait_for()
    for _ in range(60):
        desk.page.wait(0.2)
    heard = desk.page.read_heard()
    alerts = [(at_ms - begin_ms, text) for region, at_ms, text in heard if region == "said-at-once"]
    stops = [(at_ms, text) for at_ms, text in alerts if "STOP" in text]
    assert page.evaluate("feed.stops") > 30
    assert len(alerts) <= 5
    assert len(stops) >= 4
    assert min(at_ms for at_ms, _ in stops) <= 3000
    assert all(
        text.startswith("In doubt use the emergency stop or the key. STOP is not answered yet") for _, text in stops
    )
    assert judge_announcements(heard) == []
    page.evaluate("feed.answersStop = feed.isUp = true")
    for _ in range(20):
        desk.page.wait(0.2)
    last = [text for region, _, text in desk.page.read_heard() if region == "said-at-once"][-1]
    assert last == "STOP is done: the laser is off, and the board is not armed."
    assert judge_announcements(desk.page.read_heard()) == []
    assert page.locator("[role=alert], [role=status]").count() == 0  # nothing speaks besides


MUTANTS = {
    "figures of a lost board": ("status.js", '(isKnown ? text : "–")', "text"),
    "executed without a planner": ("status.js", 'hasPlanner(state) ? totals.executed : "–"', "totals.executed"),
    "not hatched": ("main.js", 'freshness.lose(["board", "budget", "display"]);', ""),
    "heights of now as the highest": (
        "main.js",
        "const { height, absorber } = peaks.take();",
        "const { height, absorber } = view.values;",
    ),
    "peaks of the loss": ("main.js", "    peaks.take(); //", "    //"),
    "plays after the end": ("queue.js", 'light === "off" ? [] : queue.active', "queue.active"),
    "pulses of the old clock": ("timeline.js", "if (boardS < this.board.s - RESTART_S) {", "if (false) {"),
    "executed pulses forgotten": (
        "timeline.js",
        "isExecuted && pulse.startS > now - HISTORY_S)",
        "isExecuted && pulse.startS > now - 0.5)",
    ),
    "times of loading": ("history.js", "Date.now() - 1000 * plan.age_s", "Date.now()"),
    "armed while paused": ("arm.js", "isDark ? PAUSED_TEXT : ", ""),
    "the whole of no page": ("fingers.js", '"lost" && this.dots > 0', '"lost"'),
    "caps of the page before": ("fingers.js", "this.caps = limited_by;", "this.caps.push(...limited_by);"),
    "alerts without a pause": ("announcer.js", "    if (leftMs > 0) {", "    if (false) {"),
}
IN_GATE = ("figures of a lost board", "heights of now as the highest", "plays after the end")


@pytest.mark.parametrize("name", [*IN_GATE, *mark_slow(name for name in MUTANTS if name not in IN_GATE)])
def test_the_judge_finds_a_page_with_one_sentence_changed(open_page, name):
    assert any(
        run_world(open_page(MUTANTS[name]), seed) for seed in (27, *range(60))
    )  # 27: a loss while pixels are warm
