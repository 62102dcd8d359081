"""Benchmark of streaming: latency from a frame to its plan, its first byte on the link and its first light, under load.

A daemon with a simulated board receives frames of 200 pixels at 20 per second, while other clients request the state
1,250 times per second, or as fast as they are answered. A bare FastAPI application in another process receives the same
bodies at the same rate under the same load; its latency is the part that the web framework causes.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
from bench_full_frames import measure_full_frames

sys.path[:0] = [str(Path(__file__).resolve().parent.parent / "tests" / "system")]
from rig import TOKEN, Board, Daemon, read_role_tokens  # noqa: E402 - of the tests
from stop_rig import FloodProcess  # noqa: E402

RUNS, SUPERSEDING = 50, 200
MINUTE_S = 60.0
PIXELS, ACTIVE, RATE_HZ, SECONDS, CLIENTS = 1511, 200, 20.0, 15.0, 4
LOAD_HZ = 1250.0
"""Requests of the other clients per second. At 0, the load is what server and clients can do."""
LEASE_S = 0.1
LOAD = "kept alive GETs"
LEAD_S = 0.03
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
            planned_sequence = plan_sequence(display, sequence, heat, budget, initial_pixels=(7,))
            points = quantise(planned_sequence.plan, scale)
            decoded = decode(points.encode_payload(), scale)
            verify(planned_sequence.plan, points.row[decoded.index], decoded, budget, display.budget)
            times.append(time.process_time() - begin_s)
        rows.append(
            (f"changed frame of {active} pixels: planned, limited, verified", 1e3 * statistics.median(times), "ms")
        )
    return rows


def measure_superseding():
    """Measure the CPU time of planning a stream's frame that truncates the one before it, mirrors near their cap."""
    from optodrive.core.types.stimuli import FrameSequence, TactileFrame
    from optodrive.daemon.engine.plan_making import PlanningRequest, make_plan
    from optodrive.daemon.engine.planning_snapshot import PlanningSnapshot, build_cut_snapshot
    from optodrive.daemon.engine.request_body import BuiltRequest
    from optodrive.daemon.engine.thermal_estimate import ThermalEstimate
    from optodrive.device.config_file import load_config
    from optodrive.link.board_setup import build_scales
    from optodrive.planning.display_model import DisplayModel

    display = DisplayModel.from_config(load_config("display-1511"))
    scales = build_scales(display.config)
    thermal = ThermalEstimate(*display.build_cold_state())
    snapshot = PlanningSnapshot(thermal, 0.0, thermal.heat, thermal.budget)
    rng, times = np.random.default_rng(7), []
    for number in range(SUPERSEDING):
        target = np.zeros(PIXELS)
        target[rng.choice(PIXELS, ACTIVE, replace=False)] = 60e-6
        built = BuiltRequest(FrameSequence((TactileFrame("f", 0.0, 60.0, target),)))
        request = PlanningRequest(lambda: built, "bench", streamed=True)  # noqa: B023 - not called later
        begin_s = time.process_time()
        plan = make_plan(display, scales, request, built, snapshot, f"p{number}", lambda fraction: None)
        planned_s = time.process_time()
        snapshot = build_cut_snapshot(plan, thermal, (number + 1) / RATE_HZ, display.budget, scales[0].tick_s)
        times.append((planned_s - begin_s, time.process_time() - planned_s))
    name = f"frame of {ACTIVE} pixels that truncates the one before it"
    make_s, cut_s = np.array(times[10:]).T
    return [*format_percentiles(f"{name}: plan", make_s), *format_percentiles(f"{name}: state at the cut", cut_s)]


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


def start_bare_server(folder, port):
    """Start the bare FastAPI application. Return its process and its URL."""
    script, url = Path(folder) / "bare.py", f"http://127.0.0.1:{port}"
    script.write_text(BARE_SERVER)
    process = subprocess.Popen([sys.executable, script, str(port)])
    while True:
        try:
            httpx.get(f"{url}/v1/state")
            return process, url
        except httpx.ConnectError:
            time.sleep(0.05)


def push_frames_under_load(url, tokens, load_hz, seconds):
    """Push frames while other clients request the state.

    Return the result of push_frames, and the answers per second.
    """
    if load_hz is None:
        return push_frames(url, seconds), 0.0
    interval_s = CLIENTS / load_hz if load_hz else 0.0
    load, begin_s = FloodProcess(LOAD, url, tokens, PIXELS, CLIENTS, interval_s), time.monotonic()
    try:
        results = push_frames(url, seconds)
    finally:
        duration_s = time.monotonic() - begin_s
        counts = load.finish()
    return results, counts["200"] / duration_s


def format_percentiles(name, values, unit="ms"):
    """Return the rows of the median and the 99th percentile."""
    return [
        (f"{name}, {label}", 1e3 * float(np.percentile(values, at)), unit)
        for label, at in (("median", 50), ("p99", 99))
    ]


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


def stream_under_load(load_hz=LOAD_HZ, lead_s=LEAD_S, seconds=SECONDS):
    """Push frames over REST under load, to a bare FastAPI and to the daemon. load_hz: None for no load."""
    with tempfile.TemporaryDirectory() as folder:
        bare_server, url = start_bare_server(folder, 8459)
        try:
            (bare_trips, *_), bare_rate = push_frames_under_load(url, {"viewer": TOKEN}, load_hz, seconds)
        finally:
            bare_server.terminate()
            bare_server.wait()
        board = Board(Path(folder), limits=f"lease_ms = {LEASE_S * 1e3:.0f}\n")
        lease = f"lease_s = {LEASE_S}"
        keys = [(lease, f"{lease}\nstream_lead_s = {lead_s}\n{UNLIMITED_RATES}\n#")]
        try:
            daemon = Daemon(Path(folder), board.port, "display-1511", keys, lease_s=LEASE_S)
            try:
                daemon.arm()
                (trips, _, state, plans), rate = push_frames_under_load(
                    daemon.url, read_role_tokens(daemon), load_hz, seconds
                )
            finally:
                daemon.stop()
        finally:
            board.stop()
    return Streaming(rate, bare_rate, trips, bare_trips, plans, state)


def measure_latency(load_hz=LOAD_HZ, lead_s=LEAD_S):
    """Measure frames over REST under load, at the daemon and at a bare FastAPI. Return the rows of the table."""
    measured = stream_under_load(load_hz, lead_s)
    finished, plans = measured.latencies, measured.plans
    first_byte_s = [latency["first_byte_s"] for latency in finished]
    rows = [
        ("other clients, requests answered per second", measured.rate_hz, "1/s"),
        ("other clients of a bare FastAPI, requests answered per second", measured.bare_rate_hz, "1/s"),
        *format_percentiles("round trip of a frame over REST", measured.trips_s),
        *format_percentiles("round trip of a frame to a bare FastAPI", measured.bare_trips_s),
    ]
    for key, name in (
        ("planned_s", "arrival to plan accepted"),
        ("first_byte_s", "arrival to first byte to the board"),
        ("first_light_s", "arrival to first light"),
    ):
        rows += format_percentiles(name, [latency[key] for latency in finished])
    lead_s = [latency["first_light_s"] - latency["first_byte_s"] for latency in finished]
    ratio = float(np.percentile(first_byte_s, 99) / np.percentile(measured.bare_trips_s, 99))
    superseded = sum(plan["status"] == "superseded" for plan in plans)
    return [
        *rows,
        ("lead of first byte over light, median", 1e3 * statistics.median(lead_s), "ms"),
        ("p99 to the first byte over p99 round trip to a bare FastAPI", ratio, "1"),
        ("fraction of frames superseded by a newer one", superseded / len(plans), "1"),
        ("underruns", measured.state["board"]["underruns"], "1"),
        ("load average, including this benchmark", os.getloadavg()[0], "1"),
    ]


def bench_stream(duration_s=MINUTE_S):
    """Return the rows of the table. duration_s: time of the full frames."""
    return measure_planning() + measure_superseding() + measure_latency() + measure_full_frames(duration_s)


def main():
    parser = argparse.ArgumentParser(prog="scripts/bench stream", description=__doc__)
    parser.add_argument("--minutes", type=float, default=1.0, help="time of the full frames beside busy loops")
    parser.add_argument("--hours", type=float, help="the same in hours")
    parser.add_argument(
        "--load-hz", type=float, default=LOAD_HZ, help="requests per second of other clients, 0: no bound"
    )
    parser.add_argument("--lead-s", type=float, default=LEAD_S, help="board.stream_lead_s, for the latency")
    parser.add_argument("--only", choices=("planning", "latency", "frames"), help="one part")
    options = parser.parse_args()
    duration_s = MINUTE_S * (options.minutes if options.hours is None else 60 * options.hours)
    parts = {
        "planning": lambda: measure_planning() + measure_superseding(),
        "latency": lambda: measure_latency(options.load_hz, options.lead_s),
        "frames": lambda: measure_full_frames(duration_s),
    }
    for name, measure in parts.items():
        for what, value, unit in measure() if options.only in (None, name) else ():
            print(f"{value:12,.3f} {unit:4} {what}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
