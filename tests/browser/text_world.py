"""A daemon of telemetry alone, random boards, plans, fingers and losses as events, and a page that reads them."""

import json
import random
from base64 import b64encode
from itertools import count
from pathlib import Path

import numpy as np

from optodrive.core.daemon_url import DEFAULT_URL as URL
from optodrive.daemon.responses.telemetry import EVENTS
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.effective_config import build_effective_config

FOLDER = Path(__file__).parents[2] / "optodrive" / "daemon" / "page"
MEDIA_TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html"}
CONFIG_JSON = build_effective_config(DisplayModel.from_config(load_config("display-16"))).model_dump_json()
CAPS = {key: cap["label"] for key, cap in json.loads(CONFIG_JSON)["limits"]["caps"].items()}
PIXELS, LEASED = 16, ("ARMING", "ARMED", "RUNNING", "HOLD")
SAFE_INPUTS = 0b011
BEGIN_S = 1_800_000_000
"""Unix time of the page when it is loaded."""

FAKE = """() => {
    const rest = window.fetch.bind(window);
    const encoder = new TextEncoder();
    const waiting = new Map();
    const feed = (window.feed = { isUp: true, answersStop: true, stops: 0, plans: {}, preview: null, heard: [] });
    window.fetch = async (path, options = {}) => {
        const url = new URL(path, location.href);
        if (url.pathname === "/v1/telemetry") {
            if (!feed.isUp) throw new TypeError("refused");
            const body = new ReadableStream({ start: (controller) => (feed.controller = controller) });
            const { controller } = feed;
            options.signal.addEventListener("abort", () => { try { controller.error(new Error("left")); } catch {} });
            return new Response(body);
        }
        if (url.pathname === "/v1/stop") {
            feed.stops++;
            if (!feed.answersStop) throw new TypeError("refused");
            return Response.json({});
        }
        if (url.pathname === "/v1/plans") {
            return Response.json(feed.preview);
        }
        if (url.pathname.startsWith("/v1/plans/")) {
            return Response.json(feed.plans[url.pathname.split("/").at(-1)]);
        }
        return rest(path, options);
    };
    const dispatch = EventTarget.prototype.dispatchEvent;
    EventTarget.prototype.dispatchEvent = function (event) {
        const done = dispatch.call(this, event);
        if (event.type === "sync") waiting.get(event.detail)();
        return done;
    };
    // Send events; done once the page has taken all of them.
    feed.send = (text, number) => new Promise((resolve) => {
        waiting.set(number, resolve);
        feed.controller.enqueue(encoder.encode(`${text}event: sync\\ndata: ${number}\\n\\n`));
    });
    addEventListener("DOMContentLoaded", () => {
        for (const name of ["said", "said-at-once"]) {
            const note = (changes) => changes.flatMap((change) => [...change.addedNodes])
                .forEach((node) => feed.heard.push([name, performance.now(), node.textContent]));
            new MutationObserver(note).observe(document.getElementById(name), { childList: true });
        }
    });
}"""

READ = """() => {
    const shown = (element) => element.checkVisibility({ visibilityProperty: true });
    const text = (id) => {
        const element = document.getElementById(id);
        return shown(element) ? element.textContent.replace(/\\s+/g, " ").trim() : "";
    };
    const all = (selector) => [...document.querySelectorAll(selector)];
    const list = (selector) => all(selector).filter(shown).map((item) => item.textContent.trim());
    const names = ["board-state", "board-means", "arming", "control", "idle", "timeline-text", "summary", "picked",
        "result", "trouble", "stopping", "tracker", "standing", "stale"];
    const figures = all("#figures dt").map((dt) => [dt.textContent, dt.nextSibling.textContent]);
    const isHatched = (id) => document.getElementById(id).closest(".panel").hasAttribute("data-stale");
    return {
        ...Object.fromEntries(names.map((name) => [name, text(name)])),
        title: document.title,
        look: document.getElementById("bar").dataset.state,
        plan: list("#now .plan").join(),
        left: list("#now .left").join(),
        queue: list("#queue li"),
        lamps: list("#lamps li"),
        fingers: list("#fingers li"),
        plans: list("#plan-history li"),
        faults: list("#fault-history li"),
        pause: text("pause"),
        stats: Object.fromEntries(figures),
        hatched: { display: isHatched("display"), budget: isHatched("gauges"), board: isHatched("figures") },
    };
}"""


class TextPage:
    """The page with the files of the package, of which mutants may replace texts, in a time of its own.

    mutant: name of a file, a text in it, and the text in its place
    """

    def __init__(self, browser, mutant=None):
        self.context = browser.new_context(reduced_motion="reduce", timezone_id="UTC", locale="en-GB")
        self.page = self.context.new_page()
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self._mutant = mutant
        self._numbers = count(1)
        self.page.clock.install(time=BEGIN_S)
        self.page.clock.pause_at(BEGIN_S + 60)
        self.now_s = BEGIN_S + 60.0
        self.page.route("**/*", self._answer)
        self.page.add_init_script(f"({FAKE})()")
        self.page.goto(f"{URL}/")
        while not self.page.evaluate("Boolean(window.feed?.controller)"):
            assert self.errors == []

    def _answer(self, route):
        path = route.request.url.removeprefix(URL).partition("?")[0]
        if path.startswith("/v1/"):
            bodies = {
                "/v1/config": CONFIG_JSON,
                "/v1/patterns": '{"patterns": [{"name": "dot", "summary": "A dot", '
                '"notes": "", "parameters": [], "policy": "trim"}]}',
            }
            me = '{"name": "ann", "role": "armer", "refused": {}}'
            route.fulfill(body=bodies.get(path, me), content_type="application/json")
            return
        name = "index.html" if path == "/" else path.removeprefix("/page/")
        text = (FOLDER / name).read_text(encoding="utf-8")
        if self._mutant is not None and self._mutant[0] == name:
            _, old, new = self._mutant
            assert text.count(old) == 1, f"the mutant of {name} has lost its place: {old!r}"
            text = text.replace(old, new)
        route.fulfill(body=text, content_type=MEDIA_TYPES[Path(name).suffix])

    def send(self, text):
        self.page.evaluate("([text, number]) => feed.send(text, number)", [text, next(self._numbers)])

    def wait(self, seconds):
        """Let the page's time go on."""
        self.page.clock.run_for(round(1000 * seconds))
        self.now_s += seconds

    def read(self):
        assert self.errors == []
        return self.page.evaluate(READ)

    def read_heard(self):
        return self.page.evaluate("feed.heard")

    def close(self):
        self.context.close()


def encode(values, unit):
    return b64encode(np.rint(np.asarray(values) / unit).astype("<u2").tobytes()).decode()


class Plan:
    """A plan of the world: rows of pulses, of which the first are executed."""

    def __init__(self, rng, number, age_s=0.0):
        self.id, self.caller = f"p{number}", rng.choice(["ann", "ben", ""])
        self.name = rng.choice(["push", "drawing", "vibration", f"frame {number}"])
        self.planned, self.executed, self.status, self.age_s = rng.randint(1, 60), 0, "queued", age_s
        self.error = None

    def describe(self):
        return {
            "plan": self.id,
            "name": self.name,
            "caller": self.caller,
            "status": self.status,
            "planned": self.planned,
            "executed": self.executed,
            "error": self.error,
            "age_s": self.age_s,
        }

    def describe_active(self):
        is_paused = self.status == "paused"
        return self.describe() | {"duration_s": 2.0, "starts_in_s": 0.5, "ends_in_s": None if is_paused else 1.5}


class World:
    """What a daemon would report, changed at random by `step`. All that was sent stays as the truth for the judge.

    executed: board time, pixel and trim of each pulse sent since the board's clock began; peaks: of the last step
    """

    def __init__(self, seed):
        rng = self.rng = random.Random(seed)
        self.rng_of_caps = random.Random(seed)  # apart, so that the other draws of a seed stay what they are
        self.board_s, self.state, self.fault, self.link, self.silence_s = 100.0, "DISARMED", None, "up", 0.02
        self.inputs, self.is_paused, self.has_planner = SAFE_INPUTS, False, True
        self.laser_on_s, self.total, self.number = 3.0, 0, 0
        self.stages = rng.choice([0, 0, 2, 3])
        self.hot_for_s = self.rng_of_caps.choice([None, None, 59.0, 700.0])
        self.plans, self.executed, self.upcoming = [], [], []
        self.page, self.caps, self.fingers, self.tracker = [], [], [], "none"
        self.height = self.absorber = self.peak = self.hottest = np.zeros(PIXELS)
        self.followed = None
        for _ in range(rng.randint(0, 3)):  # before the page was opened
            plan = self._add_plan(age_s=rng.uniform(100, 5000))
            plan.status, plan.executed = "done", plan.planned

    def _add_plan(self, age_s=0.0):
        self.number += 1
        self.plans.append(Plan(self.rng, self.number, age_s))
        return self.plans[-1]

    @property
    def active(self):
        return [plan for plan in self.plans if plan.status in ("queued", "running", "paused")]

    @property
    def is_known(self):
        return self.link == "up" and self.silence_s <= 0.5

    @property
    def reported_state(self):
        return self.state if self.is_known else "UNKNOWN"

    # --- changes ------------------------------------------------------------------------------------------------

    def step(self):
        """Change something, and let a second pass in which pulses may be executed."""
        actions = [
            self.arm,
            self.push,
            self.push,
            self.stop,
            self.fail,
            self.lose,
            self.recover,
            self.recover,
            self.pause,
        ]
        actions += [self.restart_board, self.change_page, self.touch, self.toggle_planner, self.fall_silent, self.idle]
        actions += [self.idle] * 3
        self.rng.choice(actions)()
        self.pass_second()

    def idle(self):
        pass

    def arm(self):
        if self.is_known and self.state == "DISARMED":
            self.state = self.rng.choice(["ARMING", "ARMED"])
        elif self.state == "ARMING":
            self.state = "ARMED"

    def push(self):
        if self.is_known and self.state in ("ARMED", "RUNNING"):
            self._add_plan()
        elif self.state == "DISARMED":
            self.arm()

    def _end_plans(self, status, error):
        for plan in self.active:
            plan.status, plan.error = status, error

    def stop(self):
        if self.is_known:
            self.state, self.fault, self.is_paused = "DISARMED", None, False
            if self.rng.random() < 0.7:  # otherwise the planner does not know it yet
                self._end_plans("stopped", "ended by stop")

    def fail(self):
        if self.is_known and self.state in LEASED:
            self.state, self.fault, self.is_paused = "FAULT", "INTERLOCK", False
            self.inputs = SAFE_INPUTS & ~1
            self._end_plans("failed", "the board is in FAULT INTERLOCK")

    def lose(self):
        self.link, self.is_paused = "down", False
        if self.rng.random() < 0.5:
            self._end_plans("failed", "no link to the board")

    def fall_silent(self):
        self.silence_s = self.rng.choice([0.2, 0.6, 1.9])

    def recover(self):
        if not self.is_known:
            self.link, self.silence_s, self.state, self.fault, self.inputs = "up", 0.02, "DISARMED", None, SAFE_INPUTS
            self._end_plans("failed", "no link to the board")

    def restart_board(self):
        if not self.is_known:
            self.recover()
            self.board_s, self.laser_on_s, self.executed, self.upcoming = 2.0, 0.0, [], []

    def pause(self):
        if self.is_known and self.state in ("ARMED", "RUNNING"):
            self.is_paused = not self.is_paused
            if self.is_paused:
                self.state = "ARMED"
        for plan in self.active:
            if plan.status in ("running", "paused"):
                plan.status = "paused" if self.is_paused else "running"

    def toggle_planner(self):
        if not self.has_planner or self.rng.random() < 0.3:
            self.has_planner = not self.has_planner

    def change_page(self):
        self.page = [] if self.page else self.rng.sample(range(PIXELS), self.rng.randint(1, 9))
        self.caps = self.rng_of_caps.sample(list(CAPS), self.rng_of_caps.choice([0, 0, 1, 2])) if self.page else []

    def touch(self):
        self.tracker = self.rng.choice(["seen", "lost"])
        self.fingers = list(range(1, self.rng.randint(1, 3))) if self.tracker == "seen" else []

    def pass_second(self):
        rng = self.rng
        self.board_s += 1.0
        for plan in self.plans:
            plan.age_s += 1.0
        self.peak, self.hottest = 0.6 * self.height, 0.6 * self.absorber
        self.fresh, self.fresh_planned = [], []
        can_play = self.is_known and self.state in ("ARMED", "RUNNING") and not self.is_paused
        if can_play:
            first = next(iter(self.active), None)
            self.state = "ARMED" if first is None else "RUNNING"
            if first is not None:
                first.status = "running"
                self._execute(first, rng.randint(0, 25))
            left = next((plan for plan in self.active if plan.status == "running"), None)
            if left is not None and rng.random() < 0.7:
                self.fresh_planned = [
                    (left.id, left.executed + k, self.board_s + rng.uniform(0.1, 0.95), rng.randrange(PIXELS), 0.0)
                    for k in range(rng.randint(1, left.planned - left.executed))
                ]
        self.upcoming = self.fresh_planned
        self.height = np.round(self.peak * rng.uniform(0.1, 0.9), 1)
        self.absorber = np.round(20 + (self.hottest) * rng.uniform(0.1, 0.9), 1)

    def _execute(self, plan, number):
        number = min(number, plan.planned - plan.executed)
        peak, hottest = self.peak.copy(), self.hottest.copy()
        for start_s in sorted(self.rng.uniform(self.board_s - 0.9, self.board_s - 0.02) for _ in range(number)):
            pixel = self.rng.choice([self.rng.randrange(PIXELS), 10])
            trimmed_j = self.rng.choice([0.0, 0.0, 0.001])
            pulse = (plan.id, plan.executed, start_s, pixel, trimmed_j)
            self.fresh.append(pulse)
            self.executed.append(pulse)
            plan.executed += 1
            peak[pixel] = max(peak[pixel], round(self.rng.uniform(30, 200), 1))
            hottest[pixel] = max(hottest[pixel], round(self.rng.uniform(20, 60), 1))
        self.peak, self.hottest = peak, hottest
        self.total += number
        self.laser_on_s += 0.01 * number
        if plan.executed == plan.planned:
            plan.status = "done"
            if plan is next(reversed(self.plans)) or not self.active:
                self.state = "ARMED"

    # --- events -------------------------------------------------------------------------------------------------

    def build_board(self, state):
        names = (
            "done_index",
            "queued",
            "free_points",
            "underruns",
            "crc_errors",
            "format_errors",
            "seq_errors",
            "firmware",
        )
        is_known = state != "UNKNOWN"
        return dict.fromkeys(names, 0) | {
            "state": state,
            "fault": self.fault if is_known else None,
            "hint": "close it" if self.fault and is_known else "",
            "inputs": self.inputs,
            "uid": "b",
            "temperature_c": 31.5,
            "laser_on_s": self.laser_on_s if self.link == "up" else 0.0,
        }

    def build_state(self):
        names = ("host_bad_frames", "retransmitted", "naks", "board_bad_frames", "underruns")
        link = dict.fromkeys(names, 0) | {
            "port": "/dev/ttyACM0",
            "limitation": None,
            "state": self.link,
            "error": None if self.link == "up" else "unplugged",
            "round_trip_ms": 0.4,
            "silence_s": self.silence_s if self.link == "up" else None,
            "longest_stall_ms": 1.0,
            "likely_cause": None,
            "likely_cause_age_s": None,
        }
        state = self.reported_state
        stages = [
            {
                "name": f"s{k}",
                "port": "p",
                "connected": self.link == "up",
                "error": None if self.link == "up" else "unplugged",
                "lost": None,
                "board": self.build_board(state),
                "clock_error_us": 2.0,
                "clock_drift_ppm": 1.0,
            }
            for k in range(self.stages)
        ]
        active = self.active if self.has_planner else []
        running = next((plan.id for plan in active if plan.status in ("running", "paused")), None)
        is_paused = self.is_paused and self.is_known
        control = {"caller": "ann", "armed_for_s": 5.0, "hold": False}
        return {
            "display": "display-16",
            "pixels": PIXELS,
            "link": link,
            "board": self.build_board(state),
            "stages": stages,
            "control": control if self.is_known and self.state in LEASED else None,
            "queue": {
                "waiting": 0,
                "running": running,
                "paused": is_paused,
                "pause_ends_in_s": 90.0 if is_paused else None,
                "active": [plan.describe_active() for plan in active],
                "plans": [plan.describe() for plan in self.plans[-20:]] if self.has_planner else [],
            },
            "totals": {
                "planned": sum(plan.planned for plan in self.plans) if self.has_planner else 0,
                "sent": 0,
                "executed": self.total if self.has_planner else 0,
                "timing_error": None,
                "frames_shown": 0,
                "frames_superseded": 0,
            },
            "planner": {"busy": False, "alive": self.has_planner},
            "limits": self.build_limits(),
        }

    def build_limits(self):
        if not self.has_planner:
            return {"power_share": None}
        reason = "" if self.hot_for_s is None else "the process that used it last was killed"
        return {"power_share": 1.0, "hot_reason": reason, "hot_for_s": self.hot_for_s}

    def build_batches(self, pulses):
        batches = {}
        for plan, row, start_s, pixel, trimmed_j in pulses:
            batch = batches.setdefault(
                plan,
                {"plan": plan, "name": "push"}
                | {name: [] for name in ("row", "pixel", "start_s", "width_s", "power_w", "trimmed_j", "reason")},
            )
            values = (row, pixel, start_s, 0.01, 1.0, trimmed_j, "touch_temperature" if trimmed_j else "")
            for name, value in zip(
                ("row", "pixel", "start_s", "width_s", "power_w", "trimmed_j", "reason"), values, strict=True
            ):
                batch[name].append(value)
        return list(batches.values())

    def build_events(self):
        """Return the events of the last second in the order of the daemon, each checked by its model."""
        dots = {number: min(len(self.page), number) for number in self.fingers}
        fingers = [
            {
                "number": number,
                "x_m": 0.0,
                "y_m": 0.0,
                "radius_m": 0.005,
                "dots": dots[number],
                "rate_hz": 20.0 if dots[number] else None,
                "height_share": 0.9 if dots[number] else None,
            }
            for number in self.fingers
        ]
        page_um = [50.0 if pixel in self.page else 0.0 for pixel in range(PIXELS)]
        is_up, state = self.link == "up", self.reported_state
        fault = self.fault if self.is_known else None
        board = {"board_s": self.board_s}
        events = [
            ("state", self.build_state()),
            (
                "fault",
                {
                    "board": state,
                    "link": self.link,
                    "fault": fault,
                    "hint": "close it" if fault else "",
                    "link_error": None if is_up else "unplugged",
                },
            ),
            (
                "display",
                board
                | {
                    "warm": True,
                    "height": encode(self.height, 0.1),
                    "height_peak": encode(self.peak, 0.1),
                    "absorber": encode(self.absorber, 0.1),
                    "absorber_peak": encode(20 + self.hottest, 0.1),
                },
            ),
            ("budget", board | {"caps": [], "panel_c": 25.0}),
            ("fingers", board | {"tracker": self.tracker, "fingers": fingers}),
            (
                "page",
                board
                | {"height": encode(page_um, 0.1) if self.page else "", "limited_by": self.caps, "touched_only": False},
            ),
        ]
        if self.fresh or self.fresh_planned:
            pulses = {"planned": self.build_batches(self.fresh_planned), "executed": self.build_batches(self.fresh)}
            events.append(("pulses", board | pulses))
        for kind, event in events:
            EVENTS[kind].model_validate_json(json.dumps(event))
        return "".join(f"event: {kind}\ndata: {json.dumps(event)}\n\n" for kind, event in events)
