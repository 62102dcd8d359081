"""Benchmark of streaming: latency from a frame to its plan, its first byte on the link and its first light, under load.

A daemon with a simulated board receives frames of 200 pixels at 20 per second, while other clients request the state
as fast as they can. A bare FastAPI application in another process receives the same bodies at the same rate under the
same load; its latency is the part that the web framework causes.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import httpx
import numpy as np

RUNS = 50
MINUTE_S, FULL_HZ = 60.0, 16.0
PIXELS, ACTIVE, RATE_HZ, SECONDS, CLIENTS = 1511, 200, 20.0, 15.0, 4
TOKEN = "a-token-for-a-benchmark"
CONFIG = Path(__file__).parents[1] / "configs" / "display-1511.toml"
UNLIMITED_RATES = "\n[daemon]\nrequests_per_s = 100000\nrequests_burst = 100000\n"
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
    from optodrive.core.types.stimuli import FrameSequence, TactileFrame
    from optodrive.device.config_file import load_config
    from optodrive.link.board_setup import build_board_requirements
    from optodrive.link.protocol.quantisation import decode, quantise
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.limiter.limiter import verify
    from optodrive.planning.pipeline import plan_sequence

    display = DisplayModel.from_config(load_config("display-1511"))
    scale = build_board_requirements(display.config).scale
    rng = np.random.default_rng(5)
    heat, budget = display.build_cold_state()
    rows, times = [], []
    for active in (10, 50, ACTIVE, PIXELS):
        times.clear()
        for _ in range(RUNS):
            target = np.zeros(PIXELS)
            target[rng.choice(PIXELS, active, replace=False)] = 60e-6
            sequence = FrameSequence((TactileFrame("f", 0.0, 60.0, target),))
            begin_s = time.process_time()
            planned_sequence = plan_sequence(display, sequence, heat, budget, initial_pixel=7)
            points = quantise(planned_sequence.plan, scale)
            decoded = decode(points.encode_payload(), scale)
            verify(planned_sequence.plan, points.row[decoded.index], decoded, budget, display.budget)
            times.append(time.process_time() - begin_s)
        rows.append(
            (f"changed frame of {active} pixels: planned, limited, verified", 1e3 * statistics.median(times), "ms")
        )
    return rows


class RequestLoad:
    """Clients that request the state continuously."""

    def __init__(self, url):
        self._url = url
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._send_requests, daemon=True) for _ in range(CLIENTS)]
        self.answered = 0

    def _send_requests(self):
        with httpx.Client(base_url=self._url, headers={"Authorization": f"Bearer {TOKEN}"}) as client:
            while not self._stop.is_set():
                client.get("/v1/state")
                self.answered += 1

    def __enter__(self):
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        for thread in self._threads:
            thread.join()


def push_frames(url):
    """Push frames; return round trips, s, the answers, the final state, and the plans of the last frames."""
    rng = np.random.default_rng(7)
    trips, answers = [], []
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=30) as client:
        next_s = time.monotonic()
        for _ in range(int(RATE_HZ * SECONDS)):
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


def measure_full_frames():
    """Stream full frames with a travelling wave at up to 16 per second, without other clients, from the cold state."""
    from optodrive.daemon.one_process.engine import Engine

    from optodrive.core.clock import MonotonicClock
    from optodrive.core.types.stimuli import FrameSequence, TactileFrame
    from optodrive.device.config_file import load_config
    from optodrive.link.transport.simulated import SimulatedBoard
    from optodrive.planning.display_model import DisplayModel

    display = DisplayModel.from_config(load_config("display-1511"))
    board = SimulatedBoard("", 1_000_000)
    engine = Engine(display, board, MonotonicClock())
    engine.start()
    engine.arm().result(10)
    plans, errors, first_light_s, open_plans = [], [], [], []

    def collect(plan):
        engine.get_end_future(plan).result(20)
        record = engine.get_plan(plan)
        if record.executed:
            target_um = dict(zip(record.pulses.pixel, record.pulses.target_um, strict=True))
            done = record.executed_pulses
            errors.extend(um / target_um[pixel] - 1 for pixel, um in zip(done.pixel, done.simulated_um, strict=True))
            first_light_s.append(record.latency.first_light_s)
            plans.append(set(done.pixel))

    try:
        begin_s = time.monotonic()
        for k in range(int(MINUTE_S * FULL_HZ)):
            target = 60e-6 * (1 + np.sin(0.3 * k + display.layout.column / 4))
            target[target < 5e-6] = 0
            sequence = FrameSequence((TactileFrame(str(k), 0.0, 3600.0, target),))
            open_plans.append(engine.submit(lambda s=sequence: s, "frame", streamed=True).result(20).plan)
            if len(open_plans) > 5:
                collect(open_plans.pop(0))
            time.sleep(max(0.0, begin_s + (k + 1) / FULL_HZ - time.monotonic()))
        engine.end_stream().result(10)
        time.sleep(1.0)
        for plan in open_plans:
            collect(plan)
        underruns = engine.snapshot().board.underruns
    finally:
        engine.close()
        board.release()
    name = f"full frames, {FULL_HZ:g} per second for {MINUTE_S:g} s, no other clients"
    return [
        (f"{name}: arrival to first light, median", 1e3 * statistics.median(first_light_s), "ms"),
        (f"{name}: arrival to first light, maximum", 1e3 * max(first_light_s), "ms"),
        (f"{name}: pixels driven", len(set().union(*plans)), "1"),
        (f"{name}: maximum relative error of a height", float(np.abs(errors).max()), "1"),
        (f"{name}: underruns", underruns, "1"),
    ]


def start_process(arguments, environment, ready):
    """Start a process; return it and the URL that `ready` reads or waits for."""
    process = subprocess.Popen(arguments, env=environment, stdout=subprocess.PIPE, text=True)
    return process, ready(process)


def make_bare_url_reader(port):
    """Return a function that waits for the bare server and returns its URL."""

    def ready(_):
        while True:
            try:
                httpx.get(f"http://127.0.0.1:{port}/v1/state")
                return f"http://127.0.0.1:{port}"
            except httpx.ConnectError:
                time.sleep(0.05)

    return ready


def read_daemon_url(process):
    """Read the daemon's URL from its first line of output."""
    return process.stdout.readline().split(" on ")[1].split(",")[0]


def format_percentiles(name, values, unit="ms"):
    """Return the rows of the median and the 99th percentile."""
    return [
        (f"{name}, {label}", 1e3 * float(np.percentile(values, at)), unit)
        for label, at in (("median", 50), ("p99", 99))
    ]


def bench_stream():
    """Return the rows of the table."""
    rows = measure_planning()
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "XDG_RUNTIME_DIR": folder}
        script = Path(folder) / "bare.py"
        script.write_text(BARE_SERVER)
        bare_server, url = start_process([sys.executable, script, "8459"], environment, make_bare_url_reader(8459))
        try:
            with RequestLoad(url):
                bare_trips, *_ = push_frames(url)
        finally:
            bare_server.terminate()
        optodrive = Path(sys.executable).with_name("optodrive")
        config = Path(folder) / "config.toml"
        config.write_text(CONFIG.read_text() + UNLIMITED_RATES)
        command = [optodrive, "serve", "--config", config, "--port", "0"]
        daemon, url = start_process(command, environment, read_daemon_url)
        try:
            httpx.post(f"{url}/v1/arm", headers={"Authorization": f"Bearer {TOKEN}"}, timeout=10).raise_for_status()
            with RequestLoad(url) as load:
                trips, _, state, plans = push_frames(url)
        finally:
            daemon.terminate()
    finished = [plan for plan in plans if plan["latency"]["first_light_s"] is not None]
    rows += [("other clients, requests answered per second", load.answered / SECONDS, "1/s")]
    rows += format_percentiles("round trip of a frame over REST", trips)
    rows += format_percentiles("round trip of a frame to a bare FastAPI", bare_trips)
    for key, name in (
        ("planned_s", "arrival to plan accepted"),
        ("first_byte_s", "arrival to first byte to the board"),
        ("first_light_s", "arrival to first light"),
    ):
        rows += format_percentiles(name, [plan["latency"][key] for plan in finished])
    rows += [
        (
            "p99 round trip to a bare FastAPI over p99 to the first byte",
            float(np.percentile(bare_trips, 99) / np.percentile([p["latency"]["first_byte_s"] for p in finished], 99)),
            "1",
        ),
        (
            "fraction of frames superseded by a newer one",
            sum(p["status"] == "superseded" for p in plans) / len(plans),
            "1",
        ),
        ("underruns", state["board"]["underruns"], "1"),
    ]
    return rows + measure_full_frames()
