"""Light where the fingers are: two scripted fingertips read a page of braille on 1,511 pixels.

The page is a standing frame. A tracker reports noisy places of both fingertips; a judge knows the true ones, and
reads the board's log: of the dots under a pad at a time, those count that had a pulse within the last 50 ms, which the
thermal model gives the height.
"""

import json
import random
import string
import struct
import threading
import time

import numpy as np
from measuring import Row, build_display, build_frames, running_daemon, to_ms
from websockets.sync.client import connect

from finger_judge import Touch, judge, read_pulses  # of the tests
from rig import TOKEN

NAME, HEIGHT_UM = "display-1511", 50.0
SPEEDS_M_PER_S = (0.02, 0.05, 0.1)
SECONDS = 20.0
APART_M, RADIUS_M = 0.018, 0.005
"""Distance between the two fingertips, and radius of their contacts."""
TRACKER_HZ, AGE_S, NOISE_M = 100.0, 0.01, 3e-4
LIFTED_S = 0.3
"""Time of the way to the next line, in which no finger touches."""
LATENCY_S = 0.06
LEAD_S = 0.02
READ_EVERY = 4
"""Of every READ_EVERY plans one is asked for its latencies: to ask for all takes a tenth of the planner's time."""
VIRTUAL_S, REPLACED_S = 60.0, 0.025
"""Time of reading without a daemon, and time after which each refresh is replaced there."""
OPTIONS = {
    "--seconds": {"type": float, "default": SECONDS, "help": "of reading at each speed"},
    "--lead-s": {"type": float, "default": LEAD_S, "help": "board.stream_lead_s"},
    "--virtual-s": {"type": float, "default": VIRTUAL_S, "help": "of reading in virtual time, for the caps"},
    "--seed": {"type": int, "default": 5, "help": "of the text"},
}


class ReadingHand:
    """Two fingertips that read line after line, and begin again. lines: [(x begin, x end, y)] in metres."""

    def __init__(self, lines, speed_m_per_s):
        self._lines, self._speed = lines, speed_m_per_s

    def find_touches(self, at_s):
        """Return the fingertips on the display at a time since the begin."""
        periods_s = [(end - begin) / self._speed + LIFTED_S for begin, end, _ in self._lines]
        at_s %= sum(periods_s)
        for (begin, end, y_m), period_s in zip(self._lines, periods_s, strict=True):
            if at_s < period_s:
                x_m = begin + self._speed * at_s
                return [Touch(k, x_m - k * APART_M, y_m) for k in range(2)] if x_m < end else []
            at_s -= period_s
        raise AssertionError


def build_page(display, seed):
    """Return the heights of a page of braille, µm, and its lines."""
    from optodrive.planning.stimuli.text import build_text

    rng = random.Random(seed)
    words = ["".join(rng.choices(string.ascii_lowercase, k=rng.randint(2, 6))) for _ in range(30)]
    sequence = build_text(display.config, "bench", " ".join(words), HEIGHT_UM * 1e-6, 1.0)
    target_m, layout = sequence.frames[0].target_m, display.layout
    raised = np.flatnonzero(target_m)
    lines = []
    for row in range(1, int(layout.row.max()), 4):
        dots = raised[np.abs(layout.row[raised] - row) <= 1]
        if len(dots):
            x_m = layout.x_m[dots]
            lines.append((float(x_m.min()), float(x_m.max()), float(layout.y_m[layout.row == row][0])))
    return 1e6 * target_m, lines


def connect_to(daemon, path):
    url, header = daemon.url.replace("http", "ws") + path, {"Authorization": f"Bearer {TOKEN}"}
    return connect(url, additional_headers=header, proxy=None, compression=None)


def track(link, hand, begin_s, seconds):
    """Report the fingertips until the time ends."""
    rng = np.random.default_rng(3)
    for number in range(int(seconds * TRACKER_HZ)):
        due_s = begin_s + number / TRACKER_HZ
        time.sleep(max(0.0, due_s - time.monotonic()))
        fingers = [
            {"number": touch.number, "x_m": x_m, "y_m": y_m, "radius_m": RADIUS_M}
            for touch in hand.find_touches(due_s - AGE_S - begin_s)
            for x_m, y_m in [(np.array(touch[1:]) + rng.normal(0.0, NOISE_M, 2)).tolist()]
        ]
        link.send(json.dumps({"fingers": fingers, "age_s": AGE_S + time.monotonic() - due_s}))


def measure_reading(display, heights_um, lines, speed, seconds, lead_s):
    with running_daemon(NAME, text=f"stream_lead_s = {lead_s}") as (board, daemon):
        daemon.arm()
        with connect_to(daemon, "/v1/stream?standing=true") as page, connect_to(daemon, "/v1/fingers") as fingers:
            page.send(struct.pack("<4sI", b"ODF1", 0) + np.round(heights_um * 10).astype("<u2").tobytes())
            page.recv()
            hand, begin_s, plans = ReadingHand(lines, speed), time.monotonic(), {}
            tracker = threading.Thread(target=track, args=(fingers, hand, begin_s, seconds))
            tracker.start()
            while tracker.is_alive():
                time.sleep(0.2)
                for plan in daemon.state()["queue"]["plans"][::READ_EVERY]:
                    if plan["plan"] not in plans and plan["status"] in ("done", "superseded"):
                        plans[plan["plan"]] = daemon.call("GET", f"/v1/plans/{plan['plan']}?pulses=false")["latency"]
            tracker.join()
            underruns = daemon.state()["board"]["underruns"]
        pulses = read_pulses(board, display)
    times_s = begin_s + np.arange(1.0, seconds, 0.005)
    share, _ = judge(
        pulses, display, 1e-6 * heights_um, lambda at_s: hand.find_touches(at_s - begin_s), times_s, RADIUS_M
    )
    name = f"{100 * speed:g} cm/s"
    yield f"{name}: dots under the pads at 0.9 of their height and 20 Hz", share, "1"
    for key, what in (("planned_s", "plan"), ("first_byte_s", "first byte"), ("first_light_s", "first light")):
        times_s = [latency[key] for latency in plans.values() if latency[key] is not None]
        yield Row(f"{name}: fingers to {what}", to_ms(times_s), aim=1e3 * LATENCY_S)
    is_within = pulses.start_s > begin_s
    yield f"{name}: pulses per second", is_within.sum() / seconds, "1/s"
    yield f"{name}: energy per second", pulses.energy_j[is_within].sum() / seconds, "J/s"
    gaps = np.diff(pulses.start_s[is_within])
    yield Row(f"{name}: from pulse to pulse", to_ms(gaps.tolist()))
    yield f"{name}: underruns", underruns, "1"


class VirtualClock:
    """A clock that both the host and the board have. at_s: its present time."""

    at_s = 0.0

    def now_s(self):
        return self.at_s


def measure_virtual(display, heights_um, lines, speed, seconds, lead_s):
    """Plan the refreshes of a page without a daemon, and yield the largest use of each cap."""
    from optodrive.core.types.fingers import FingerPlace
    from optodrive.daemon.engine.active_plan import ThermalEstimate
    from optodrive.daemon.engine.page_refresh import PageRefresh
    from optodrive.daemon.engine.plan_making import PlanningRequest, PlanningSnapshot, build_cut_snapshot, make_plan
    from optodrive.daemon.push import BuiltRequest, Push
    from optodrive.link.board_setup import build_scales
    from optodrive.planning.limiter.cap_checks import compute_panel_k, compute_usage

    clock, hand = VirtualClock(), ReadingHand(lines, speed)
    scales, built = build_scales(display.config), BuiltRequest(build_frames([1e-6 * heights_um], 60.0))
    page = PageRefresh(display.layout, clock, clock.now_s, lambda: lead_s)
    push = Push("bench", {}, 0.0, 0, streamed=True, lists_pulses=False, standing=True)
    request = PlanningRequest(lambda: built, push, select=page.select)
    thermal = ThermalEstimate(*display.build_cold_state())
    snapshot = PlanningSnapshot(thermal, lead_s, thermal)
    used, panel_k, pulses = {}, 0.0, 0
    while clock.at_s < seconds:
        touches = hand.find_touches(clock.at_s)
        page.update_fingers(clock.at_s, [FingerPlace(*touch, RADIUS_M) for touch in touches])
        plan = make_plan(display, scales, request, built, snapshot, "p", lambda fraction: None)
        clock.at_s += REPLACED_S
        snapshot = build_cut_snapshot(plan, thermal, clock.at_s + lead_s, display.budget, scales[0].tick_s)
        pulses += snapshot.cut.row
        for usage in compute_usage(snapshot.budget, display.budget, 0.0):
            used[usage.cap] = max(used.get(usage.cap, 0.0), usage.used / usage.limit)
        panel_k = max(panel_k, compute_panel_k(snapshot.budget, display.budget, 0.0))
    name = f"{100 * speed:g} cm/s for {seconds:g} s in virtual time"
    yield f"{name}: pulses", pulses, "1"
    for cap, share in used.items():
        yield Row(f"{name}: largest use of {cap}", share, "1", aim=1.0)
    yield f"{name}: bound on the panel above the room", panel_k, "K"


def measure(seconds, lead_s, virtual_s, seed):
    display = build_display(NAME)
    heights_um, lines = build_page(display, seed)
    for speed in SPEEDS_M_PER_S if seconds else ():
        yield from measure_reading(display, heights_um, lines, speed, seconds, lead_s)
    yield from measure_virtual(display, heights_um, lines, SPEEDS_M_PER_S[1], virtual_s, lead_s)
