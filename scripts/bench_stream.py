"""Streaming: latency from a frame to its plan, its first byte on the link and its first light, under load.

A daemon with a simulated board receives frames of 200 pixels at 20 per second, while other clients request the state
1,250 times per second, or as fast as they are answered. A bare FastAPI application in another process receives the same
bodies at the same rate under the same load; its latency is the part that the web framework causes.
"""

import json
import os
import struct
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path

import httpx
import numpy as np
from frame_stream import measure_full_frames
from measuring import LEASE_S, Row, build_display, build_frames, measure_times_s, running_daemon, to_ms
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from optodrive.client import Display
from process_memory import list_processes  # of the tests
from rig import TOKEN, read_role_tokens  # of the tests
from stop_rig import FloodProcess

RUNS, SUPERSEDING = 50, 200
HORIZON_S = 0.1
PIXELS, ACTIVE, RATE_HZ, SECONDS, CLIENTS = 1511, 200, 20.0, 15.0, 4
SHOWN_PIXELS, SHOWN_RATES_HZ, SHOWN_S = (1, 4), (5.0, 20.0, 30.0, 60.0, 100.0, 200.0), 3.0
LOAD_HZ = 1250.0
"""Requests of the other clients per second. At 0, the load is what server and clients can do."""
LOAD = "kept alive GETs"
LEAD_S = 0.03
ENDING_S = 0.7
"""Time after the last frame, in which it is drawn."""
OPTIONS = {
    "--minutes": {"type": float, "default": 1.0, "help": "time of the full frames beside busy loops"},
    "--hours": {"type": float, "help": "the same in hours"},
    "--load-hz": {"type": float, "default": LOAD_HZ, "help": "requests per second of other clients, 0: no bound"},
    "--lead-s": {"type": float, "default": LEAD_S, "help": "board.stream_lead_s, for the latency"},
    "--only": {"choices": ("planning", "latency", "websocket", "rates", "frames"), "help": "one part"},
}
UNLIMITED_RATES = "[daemon]\nrequests_per_s = 1e5\nrequests_burst = 100000"
"""The daemon must serve the load; its rate limit must not reject it."""

BARE_SERVER = """
import sys
import uvicorn
from fastapi import FastAPI, Request

app = FastAPI()

@app.post("/v1/plans")
async def push(request: Request):
    return {"bytes": len(await request.body())}

@app.get("/v1/state")
async def state():
    return {}

uvicorn.run(app, port=int(sys.argv[1]), log_level="warning", access_log=False)
"""


def build_random_frame(rng):
    """Build the targets of a frame of random pixels, µm by pixel."""
    pixels = rng.choice(PIXELS, ACTIVE, replace=False)
    return {str(pixel): 60.0 for pixel in pixels.tolist()}


def measure_planning():
    """Measure the CPU time from a frame to verified bytes: plan, limit, predict, quantise, decode, verify."""
    from optodrive.link.board_setup import build_board_requirements
    from optodrive.link.protocol.quantisation import decode, quantise
    from optodrive.planning.limiter.limiter import verify
    from optodrive.planning.pipeline import plan_sequence

    display, rng = build_display(), np.random.default_rng(5)
    scale = build_board_requirements(display.config).scale
    heat, budget = display.build_cold_state()

    def plan_frame(sequence):
        planned = plan_sequence(display, sequence, heat, budget, initial_pixels=(7,))
        points = quantise(planned.plan, scale)
        decoded = decode(points.encode_payload(), scale)
        verify(planned.plan, points.row[decoded.index], decoded, budget, display.budget)

    for active in (10, 50, ACTIVE, PIXELS):
        sequences = iter([draw_frame(rng, active) for _ in range(RUNS)])
        times_s = measure_times_s(lambda: plan_frame(next(sequences)), RUNS, time.process_time)
        yield Row(f"changed frame of {active} pixels: planned, limited, verified", to_ms(times_s))


def draw_frame(rng, active):
    """Return a sequence of a frame of random pixels."""
    target_m = np.zeros(PIXELS)
    target_m[rng.choice(PIXELS, active, replace=False)] = 60e-6
    return build_frames([target_m], 60.0)


def measure_superseding():
    """Measure the CPU time of planning a stream's frame that truncates the one before it, mirrors near their cap."""
    from optodrive.daemon.engine.active_plan import ThermalEstimate
    from optodrive.daemon.engine.plan_making import PlanningRequest, PlanningSnapshot, build_cut_snapshot, make_plan
    from optodrive.daemon.push import BuiltRequest, Push
    from optodrive.link.board_setup import build_scales

    display = build_display()
    scales, push = build_scales(display.config), Push("bench", {}, 0.0, 0, streamed=True, lists_pulses=False)
    for planned, horizon_s in (("whole", inf), (f"its first {1e3 * HORIZON_S:g} ms", HORIZON_S)):
        thermal = ThermalEstimate(*display.build_cold_state())
        snapshot = PlanningSnapshot(thermal, 0.0, thermal)
        rng, times = np.random.default_rng(7), []
        for number in range(SUPERSEDING):
            built = BuiltRequest(draw_frame(rng, ACTIVE))
            request = PlanningRequest(lambda built=built: built, push)
            begin_s = time.process_time()
            plan = make_plan(display, scales, request, built, snapshot, f"p{number}", lambda fraction: None, horizon_s)
            planned_s = time.process_time()
            snapshot = build_cut_snapshot(plan, thermal, (number + 1) / RATE_HZ, display.budget, scales[0].tick_s)
            times.append((planned_s - begin_s, time.process_time() - planned_s))
        for what, times_s in zip(("plan", "state at the cut"), np.transpose(times[10:]), strict=True):
            name = f"frame of {ACTIVE} pixels that truncates the one before it, {planned}: {what}"
            yield Row(name, to_ms(times_s.tolist()))


def push_frames(url, seconds):
    """Push frames for a time.

    Return round trips, s, the answers, the final state, and the plans of the last frames.
    """
    rng = np.random.default_rng(7)
    trips, answers = [], []
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=30) as client:
        next_s = time.monotonic()
        for _ in range(int(RATE_HZ * seconds)):
            body = json.dumps({"frames": [{"show_at_s": 0, "duration_s": 60, "target_um": build_random_frame(rng)}]})
            begin_s = time.monotonic()
            response = client.post("/v1/plans", params={"newest": True}, content=body)
            trips.append(time.monotonic() - begin_s)
            if response.is_error:
                raise RuntimeError(response.text)
            answers.append(response.json())
            next_s = max(next_s + 1 / RATE_HZ, time.monotonic())
            time.sleep(max(0.0, next_s - time.monotonic()))
        return (
            trips,
            answers,
            client.get("/v1/state").json(),
            [client.get(f"/v1/plans/{answer['plan']}", params={"pulses": False}).json() for answer in answers[-190:]]
            if "plan" in answers[0]
            else [],
        )


@contextmanager
def bare_server(port):
    """Run the bare FastAPI application, and yield its URL."""
    process, url = subprocess.Popen([sys.executable, "-c", BARE_SERVER, str(port)]), f"http://127.0.0.1:{port}"
    try:
        while True:
            try:
                httpx.get(f"{url}/v1/state")
                break
            except httpx.ConnectError:
                time.sleep(0.05)
        yield url
    finally:
        process.terminate()
        process.wait()


@contextmanager
def under_load(url, tokens, load_hz):
    """Let other clients request the state during this block. Yield a list, in which it ends with their rate.

    load_hz: requests per second, 0 for no bound, None for no load
    """
    rates_hz = []
    if load_hz is None:
        yield rates_hz
        rates_hz.append(0.0)
        return
    interval_s = CLIENTS / load_hz if load_hz else 0.0
    load, begin_s = FloodProcess(LOAD, url, tokens, PIXELS, CLIENTS, interval_s), time.monotonic()
    try:
        yield rates_hz
    finally:
        duration_s = time.monotonic() - begin_s
        rates_hz.append(load.finish()["200"] / duration_s)


def push_frames_under_load(url, tokens, load_hz, seconds):
    """Push frames while other clients request the state.

    Return the result of push_frames, and the answers per second.
    """
    with under_load(url, tokens, load_hz) as rates_hz:
        results = push_frames(url, seconds)
    return results, rates_hz[0]


@dataclass
class Streaming:
    """Results of pushing frames under load, at the daemon and at a bare FastAPI.

    rate_hz, bare_rate_hz: answers to the other clients; trips_s, bare_trips_s: round trips of the frames
    plans: the last ones; latencies: of those that were shown; state: the final one
    """

    rate_hz: float
    bare_rate_hz: float
    trips_s: list[float]
    bare_trips_s: list[float]
    plans: list[dict]
    state: dict

    @property
    def latencies(self):
        return [plan["latency"] for plan in self.plans if plan["latency"]["first_light_s"] is not None]


def read_cpu_s(pid):
    """Return the processor time that a process has used so far, s."""
    return sum(int(path.read_text().split()[0]) for path in Path(f"/proc/{pid}/task").glob("*/schedstat")) * 1e-9


def stream_frames(daemon, seconds):
    """Stream frames over a WebSocket. Return the final answers of those that were shown, and the planner's cores."""
    rng, answers = np.random.default_rng(7), []
    planner = list_processes(daemon.process.pid)["opto-planner"]
    url, header = daemon.url.replace("http", "ws") + "/v1/stream", {"Authorization": f"Bearer {TOKEN}"}
    with connect(url, additional_headers=header, proxy=None, compression=None) as link:

        def read():
            with suppress(WebSocketException):
                answers.extend(json.loads(text) for text in link)

        reader = threading.Thread(target=read)
        reader.start()
        begin_s, begin_cpu_s = time.monotonic(), read_cpu_s(planner)
        for number in range(int(RATE_HZ * seconds)):
            heights = np.zeros(PIXELS, dtype="<u2")
            heights[rng.choice(PIXELS, ACTIVE, replace=False)] = 600
            link.send(struct.pack("<4sI", b"ODF1", number) + heights.tobytes())
            time.sleep(max(0.0, begin_s + (number + 1) / RATE_HZ - time.monotonic()))
        cores = (read_cpu_s(planner) - begin_cpu_s) / (time.monotonic() - begin_s)
        time.sleep(ENDING_S)
        link.close()
        reader.join()
    return [answer for answer in answers if answer["status"] in ("done", "superseded") and "latency" in answer], cores


def measure_websocket(load_hz=LOAD_HZ, lead_s=LEAD_S):
    """Measure frames over a WebSocket under load, and bodies at the same rate at a bare FastAPI. Yield the rows."""
    with bare_server(8459) as url:
        (bare_trips, *_), _ = push_frames_under_load(url, {"viewer": TOKEN}, load_hz, SECONDS)
    with running_daemon("display-1511", LEASE_S, f"stream_lead_s = {lead_s}\n{UNLIMITED_RATES}") as (_, daemon):
        daemon.arm()
        with under_load(daemon.url, read_role_tokens(daemon), load_hz):
            answers, cores = stream_frames(daemon, SECONDS)
        underruns = daemon.state()["board"]["underruns"]
    yield "WebSocket: frames shown of those sent", len(answers) / (RATE_HZ * SECONDS), "1"
    yield "WebSocket: processor time of the planner process per second", cores, "core"
    yield Row("WebSocket: round trip of a body to a bare FastAPI", to_ms(bare_trips))
    for key, name in (("planned_s", "plan accepted"), ("first_byte_s", "first byte"), ("first_light_s", "first light")):
        times_s = [answer["latency"][key] for answer in answers if answer["latency"][key] is not None]
        yield Row(
            f"WebSocket: arrival to {name}",
            to_ms(times_s),
            reference="a bare FastAPI",
            reference_values=to_ms(bare_trips),
        )
    yield "WebSocket: underruns", underruns, "1"


def measure_rates():
    """Stream frames of a few pixels at rising rates. Yield the frames shown per second, of those sent."""
    for count in SHOWN_PIXELS:
        for rate_hz in SHOWN_RATES_HZ:
            with running_daemon("display-437", LEASE_S, UNLIMITED_RATES) as (_, daemon):
                daemon.arm()
                with Display(daemon.url, token=TOKEN) as display, display.stream() as stream:
                    heights_um = {200 + pixel: 60.0 for pixel in range(count)}
                    begin_s = time.monotonic()
                    for number in range(int(rate_hz * SHOWN_S)):
                        stream.send(heights_um)
                        time.sleep(max(0.0, begin_s + (number + 1) / rate_hz - time.monotonic()))
                    time.sleep(ENDING_S)
                    shown = stream.counts.shown
            yield f"frames of {count} pixels shown per second of {rate_hz:g} sent", shown / SHOWN_S, "1/s"


def stream_under_load(load_hz=LOAD_HZ, lead_s=LEAD_S, seconds=SECONDS):
    """Push frames over REST under load, to a bare FastAPI and to the daemon. load_hz: None for no load."""
    with bare_server(8459) as url:
        (bare_trips, *_), bare_rate = push_frames_under_load(url, {"viewer": TOKEN}, load_hz, seconds)
    with running_daemon("display-1511", LEASE_S, f"stream_lead_s = {lead_s}\n{UNLIMITED_RATES}") as (_, daemon):
        daemon.arm()
        tokens = read_role_tokens(daemon)
        (trips, _, state, plans), rate = push_frames_under_load(daemon.url, tokens, load_hz, seconds)
    return Streaming(rate, bare_rate, trips, bare_trips, plans, state)


def measure_latency(load_hz=LOAD_HZ, lead_s=LEAD_S):
    """Measure frames over REST under load, at the daemon and at a bare FastAPI. Yield the rows."""
    measured = stream_under_load(load_hz, lead_s)
    latencies, plans = measured.latencies, measured.plans
    yield "other clients, requests answered per second", measured.rate_hz, "1/s"
    yield "other clients of a bare FastAPI, requests answered per second", measured.bare_rate_hz, "1/s"
    yield Row("round trip of a frame over REST", to_ms(measured.trips_s))
    yield Row("round trip of a frame to a bare FastAPI", to_ms(measured.bare_trips_s))
    for key, name in (
        ("planned_s", "arrival to plan accepted"),
        ("first_byte_s", "arrival to first byte to the board"),
        ("first_light_s", "arrival to first light"),
    ):
        yield Row(name, to_ms(latency[key] for latency in latencies))
    first_byte_s = np.array([latency["first_byte_s"] for latency in latencies])
    lead_s = np.array([latency["first_light_s"] for latency in latencies]) - first_byte_s
    yield Row("lead of first byte over light", to_ms(lead_s.tolist()))
    ratio = np.percentile(first_byte_s, 99) / np.percentile(measured.bare_trips_s, 99)
    yield "p99 to the first byte over p99 round trip to a bare FastAPI", ratio, "1"
    superseded = sum(plan["status"] == "superseded" for plan in plans)
    yield "fraction of frames superseded by a newer one", superseded / len(plans), "1"
    yield "underruns", measured.state["board"]["underruns"], "1"
    yield "load average, including this benchmark", os.getloadavg()[0], "1"


def measure(minutes=1.0, hours=None, load_hz=LOAD_HZ, lead_s=LEAD_S, only=None):
    if only in (None, "planning"):
        yield from measure_planning()
        yield from measure_superseding()
    if only in (None, "latency"):
        yield from measure_latency(load_hz, lead_s)
    if only in (None, "websocket"):
        yield from measure_websocket(load_hz, lead_s)
    if only in (None, "rates"):
        yield from measure_rates()
    if only in (None, "frames"):
        yield from measure_full_frames(60.0 * minutes if hours is None else 3600.0 * hours)
