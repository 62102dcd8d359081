"""One table of times that depend on the computer, with their aims, in a few minutes. Nothing is asserted.

Beside each row stands how late the computer woke a process that only sleeps, at the same time, and, where there is one,
the ratio to a reference of the same run. Daemon, board, callers and this benchmark share the computer.
"""

import asyncio
import fcntl
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path

import httpx
import numpy as np
import pytest
from bench_boards import Bench as SeveralBoards
from bench_latency import RATES_HZ, WAYS, measure_errors, run_daemon
from bench_stop import run_flood
from bench_stream import bare_server, stream_under_load
from measuring import LEASE_S, Row, Sleeper, measure_times_s, realtime_priority, running_daemon, time_limit, to_ms
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from floods import Target, abandon_dry_run, build_full_frames, build_refused_bodies
from optodrive.client import Display
from optodrive.core.clock import MonotonicClock
from optodrive.core.types.stimuli import PulseTrain
from optodrive.daemon.supervisor.supervisor import END_GRACE_S
from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.serial_port import SerialPort
from optodrive.planning.stimuli.sequence_file import parse_sequence
from optodrive.planning.stimuli.train_json import check_trains
from rig import OPTODRIVE, TOKEN, Board, long_train, read_role_tokens, wait_for
from service_manager import Manager, reload  # of the tests
from stop_rig import PIXELS, StopRig, build_http_sender, is_gate_on, is_unarmed

LIMIT_S = 90.0
"""Longest time of one measurement, after which it counts as failed."""
STOP_MAX_MS = 50.0
FLOODS = ("rest", "refused bodies of 8 MB", "valid previews", "pings", "idle connections", "connection churn")
FLOOD_S, STREAM_S = 3.0, 4.0
BARE = "a bare FastAPI's answer"


class Bench:
    """A rig and a server that measurements share, started when they are first needed, until the benchmark ends."""

    def __init__(self, stack):
        self._stack = stack

    def make_folder(self):
        return Path(self._stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))

    @cached_property
    def stop_rig(self):
        rig = StopRig(self.make_folder(), LEASE_S)
        self._stack.callback(rig.close)
        return rig

    @cached_property
    def bare_url(self):
        return httpx.URL(self._stack.enter_context(bare_server(8458)))


MEASUREMENTS = {}


def measurement(name):
    """Decorate a function that yields the rows of one measurement."""
    return partial(MEASUREMENTS.setdefault, name)


def run_quietly(*command, **environment):
    """Run a command, and return its duration, s."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": {**os.environ, **environment}}
    return measure_times_s(lambda: subprocess.run(command, check=True, **quiet), 1)[0]


# --- STOP ------------------------------------------------------------------------------------------------------------


def measure_stop(name, bench):
    send_bare = build_http_sender(bench.bare_url, "GET", "/v1/state")
    with realtime_priority():  # the times must not include the wait of this process for a core
        for path, way in (("http", "over HTTP"), ("socket", "at the link's socket")):
            measure_bare = {"measure_reference": lambda: measure_times_s(send_bare, 1)[0]}
            result = run_flood(bench.stop_rig, name, 100, FLOOD_S, path=path, **measure_bare)
            counts = ((len(result.darkened), "dark before"), (result.relit, "relit"), (result.not_begun, "no show"))
            note = ", ".join(f"{count} {what}" for count, what in counts if count)
            for what, values_s in (("gate off", result.gate_off_s), ("its answer", result.answered_s)):
                reference = BARE, to_ms(result.reference_s), note
                yield Row(f"STOP {way} to {what}, {name}", to_ms(values_s), "ms", STOP_MAX_MS, *reference)


for flood in FLOODS:
    measurement(f"stop-{flood.replace(' ', '-')}")(partial(measure_stop, flood))


@measurement("command")
def measure_command(bench):
    rig, gate_off_s, ended_s, empty_s = bench.stop_rig, [], [], []
    for _ in range(5):
        empty_s.append(run_quietly(sys.executable, "-c", "pass"))
        begin, begin_s = rig.start_show(), time.monotonic()
        runtime = str(rig.daemon.config.parent)
        ended_s.append(run_quietly(OPTODRIVE, "stop", "--url", rig.daemon.url, XDG_RUNTIME_DIR=runtime))
        gate_off_s.append(rig.to_host_s(rig.tail.find(is_unarmed, begin, "dark")) - begin_s)
    for what, values_s in (("gate off", gate_off_s), ("its end", ended_s)):
        yield Row(f"`optodrive stop` to {what}", to_ms(values_s), "ms", None, "`python -c pass`", to_ms(empty_s))


@measurement("audit")
def measure_audit(bench):
    """A FIFO that nobody reads as the audit file."""
    fifo = bench.make_folder() / "audit"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    fcntl.fcntl(reader, fcntl.F_SETPIPE_SZ, 4096)
    try:
        with running_daemon(text=f'[daemon]\naudit = "{fifo}"') as (_, daemon):
            # The 60 write more lines than the pipe holds.
            free, _, stuck = (to_ms(measure_times_s(lambda: daemon.call("POST", "/v1/stop"), n)) for n in (10, 60, 30))
            ended_s = end(daemon)
    finally:
        os.close(reader)
    name = "STOP over HTTP behind an audit path that hangs"
    yield Row(name, stuck, "ms", 500.0, "with a path that is free", free)
    yield Row("end of that daemon after SIGTERM", 1e3 * ended_s, aim=10e3)


def end(daemon):
    """End a daemon by SIGTERM, and return the time that it takes, s."""
    return measure_times_s(lambda: (daemon.process.terminate(), daemon.process.wait()), 1)[0]


# --- frames ----------------------------------------------------------------------------------------------------------


def measure_stream(load_hz, bench):
    streaming = stream_under_load(load_hz, seconds=STREAM_S)
    beside = f"beside {streaming.rate_hz:.0f} requests/s" if load_hz else "at rest"
    for what, key, aim in (("first byte", "first_byte_s", None), ("first light", "first_light_s", 1000.0)):
        values = to_ms(latency[key] for latency in streaming.latencies)
        yield Row(f"push to {what}, {beside}", values, "ms", aim, BARE, to_ms(streaming.bare_trips_s))


measurement("stream-rest")(partial(measure_stream, None))
measurement("stream-load")(partial(measure_stream, 300.0))


@measurement("latency")
def measure_latency(bench):
    """Reported latencies at 5 to 60 frames/s against the instants of caller and board."""
    with run_daemon(bench.make_folder()) as (board, daemon):
        for way in WAYS:
            errors_s = [error_s for rate_hz in RATES_HZ for error_s in measure_errors(board, daemon, way, rate_hz, 6)]
            yield Row(f"error of a reported latency, {way}, 5 to 60 frames/s", to_ms(errors_s), aim=1.0)


@measurement("onset")
def measure_onset(bench):
    train = {"pixel": 17, "start_s": 0.3, "duration_s": 0.1, "pulse_width_s": 0.01, "gap_s": 0.03, "power_w": 1.0}
    errors_s = []
    with running_daemon() as (board, daemon):
        daemon.arm()
        zero_s = float(Path(f"{board.port}.clock").read_text())
        for _ in range(8):
            board.forget()
            announced = daemon.call("POST", "/v1/plans", json={"trains": [train]})
            ended = daemon.finished(announced["plan"])
            gate_on_s = zero_s + 1e-6 * next(event["t_us"] for event in board.of("gate") if event["on"])
            errors_s.append(abs(announced["onset"]["monotonic_s"] + ended["delay_s"] - gate_on_s))
    yield Row("error of an announced onset", [1e6 * error_s for error_s in errors_s], "µs", 1000.0)


@measurement("parsing")
def measure_parsing(bench):
    frame = {"show_at_s": 0, "duration_s": 1, "target_um": {str(k): 50.0 for k in range(1511)}}
    text, config = json.dumps({"frames": [frame]}), load_config("display-1511")
    trains = [PulseTrain(k, 0.0005 * k, 50.0, 0.0002, 0.0018, 1.0) for k in range(4)]
    for what, work, runs, aim in (
        ("a frame of 1,511 pixels read", lambda: parse_sequence(text, config, "f"), 30, 20.0),
        ("100,000 pulses checked", lambda: check_trains(trains, "trains", config), 5, 500.0),
    ):
        yield Row(f"{what}, CPU time", to_ms(measure_times_s(work, runs, time.process_time)), aim=aim)


# --- other callers ---------------------------------------------------------------------------------------------------


def post(rig, body, role="operator", **params):
    headers = {"Authorization": f"Bearer {read_role_tokens(rig.daemon)[role]}"}
    return httpx.post(f"{rig.daemon.url}/v1/plans", params=params, content=body, headers=headers, timeout=None)


@measurement("gap")
def measure_gap(bench):
    """Longest time without light while another caller's request is under way."""
    rig, previews = bench.stop_rig, [build_full_frames(300, PIXELS)] * 3
    for what, bodies, params in (
        ("refused body of 8 MB", build_refused_bodies(PIXELS), {}),
        ("preview of 300 frames", previews, {"dry_run": True}),
    ):
        gaps_s = []
        with rig.running_show() as begin:
            for body in bodies:
                begin_s = time.monotonic()
                post(rig, body, **params)
                rig.tail.read()
                on_s = [rig.to_host_s(event) for event in rig.tail.events[begin:] if is_gate_on(event)]
                gaps_s.append(max(b - a for a, b in pairwise([on_s[0], *on_s]) if b >= begin_s))
        yield Row(f"gap of light beside a {what}", to_ms(gaps_s), aim=500.0)


@measurement("dry-runs")
def measure_dry_runs(bench):
    rig = bench.stop_rig
    base, small = rig.client.base_url, b'{"frames":[{"show_at_s":0,"duration_s":1,"target_um":{"17":60}}]}'
    target = Target(base.host, base.port, read_role_tokens(rig.daemon), PIXELS)
    pushed_s, dropped_s = [], []
    for _ in range(3):
        rig.arm()
        for _ in range(5):
            asyncio.run(abandon_dry_run(target, 730))
        pushed_s += measure_times_s(lambda: post(rig, small, role="armer").raise_for_status(), 1)
        rig.client.post("/v1/stop")
        dropped_s += measure_times_s(lambda: post(rig, small, dry_run=True).raise_for_status(), 1)
    body, refused_s = build_full_frames(100, PIXELS), []

    def push(_):
        begin_s = time.monotonic()
        if post(rig, body, dry_run=True).status_code in (429, 503):
            refused_s.append(time.monotonic() - begin_s)

    with ThreadPoolExecutor(24) as pool:
        list(pool.map(push, range(24)))
    yield Row("small push behind five abandoned dry runs", to_ms(pushed_s), aim=1000.0)
    yield Row("small dry run behind five abandoned ones", to_ms(dropped_s), aim=8000.0)
    yield Row("refusal of dry runs beyond those that may wait", to_ms(refused_s), aim=5000.0)


@measurement("revocation")
def measure_revocation(bench):
    """From the removal of a token from the file, with the request to reload, to the end of its WebSocket."""
    folder, values_s = bench.make_folder(), []
    tokens, secrets = folder / "tokens.toml", {"rig": TOKEN, "ben": "another-token-for-ben"}

    def write(*names):
        entries = (f'[[token]]\nname = "{name}"\nrole = "armer"\nsecret = "{secrets[name]}"\n' for name in names)
        tokens.write_text('format = "optodrive-tokens"\nversion = 1\n' + "".join(entries))
        tokens.chmod(0o600)

    write("rig")
    with pytest.MonkeyPatch.context() as patch:
        manager = Manager(folder, patch)
        with running_daemon(text=f'[daemon]\ntokens = "{tokens}"') as (_, daemon):
            for _ in range(4):
                write("rig", "ben")
                reload(daemon, manager, lambda text: text)
                header = {"Authorization": f"Bearer {secrets['ben']}"}
                url = f"ws{daemon.url.removeprefix('http')}/v1/stream"
                with connect(url, additional_headers=header, proxy=None, compression=None) as stream:
                    ended = []

                    def read(stream=stream, ended=ended):
                        with suppress(ConnectionClosed):
                            stream.recv()
                        ended.append(time.monotonic())

                    thread = threading.Thread(target=read)
                    thread.start()
                    begin_s = time.monotonic()
                    write("rig")
                    reload(daemon, manager, lambda text: text)
                    thread.join()
                values_s.append(ended[0] - begin_s)
        manager.close()
    yield Row("token removed to the end of its connection", to_ms(values_s), aim=500.0)


@measurement("hold")
def measure_hold(bench):
    values_s = []
    with running_daemon() as (board, daemon):
        for _ in range(8):
            board.forget()
            display = Display(daemon.url, TOKEN)
            display.arm(hold=True)
            display.push(long_train(seconds=20.0), wait=False)
            wait_for(lambda: len(board.of("pulse")) > 3, "pulses")
            released_us = board.now_us()
            display.close()
            values_s.append(1e-6 * (wait_for_dark_us(board) - released_us))
    yield Row("release of a hold to dark", to_ms(values_s), aim=500.0)


def wait_for_dark_us(board):
    """Return the time of the board's clock at which it left its armed states for good."""
    return wait_for(lambda: list(filter(is_unarmed, board.of("state"))), "dark")[-1]["t_us"]


# --- processes -------------------------------------------------------------------------------------------------------


def light(board, daemon):
    """Let a long train run."""
    if daemon.board_state() != "ARMED":
        arm_when_ready(daemon)
    board.forget()
    daemon.call("POST", "/v1/plans", json=long_train(seconds=30.0))
    wait_for(lambda: len(board.of("pulse")) > 3, "pulses")


@measurement("restart")
def measure_restart(bench):
    with running_daemon() as (board, daemon):
        for name in ("planner", "web", "link"):
            dark_s, served_s = zip(*(kill_and_await(board, daemon, name) for _ in range(2)), strict=True)
            yield Row(f"SIGKILL of {name} to dark", to_ms(dark_s), aim=100.0)
            yield Row(f"SIGKILL of {name} to the next one's service", to_ms(served_s), aim=3000.0)


def kill_and_await(board, daemon, name):
    """Kill a process while a train runs. Return the times until dark and until the next one serves, s."""
    light(board, daemon)
    pid = daemon.find_process(name)
    killed_us, killed_s = board.now_us(), time.monotonic()
    os.kill(pid, signal.SIGKILL)

    def is_served():
        if daemon.find_process(name) in (None, pid):
            return False
        with suppress(httpx.HTTPError):
            state = daemon.client.get("/v1/state").json()
            refused = daemon.client.post("/v1/plans", json=long_train())
            return state["link"]["state"] == "up" and refused.status_code == 409  # the board is not armed
        return False

    wait_for(is_served, name)
    return find_dark_s(board, killed_us), time.monotonic() - killed_s


def arm_when_ready(daemon):
    """Acknowledge a fault and arm, once the daemon's processes and its link have recovered from an earlier loss."""

    def is_armed():
        return all(daemon.client.post(path).status_code == 200 for path in ("/v1/disarm", "/v1/arm"))

    wait_for(is_armed, "an armed board")


def find_dark_s(board, since_us):
    """Return the time from one of the board's clock until the gate was off for good, s."""
    off_us = [event["t_us"] for event in board.of("gate") if not event["on"]]
    return max(0.0, 1e-6 * (off_us[-1] - since_us))


@measurement("loss")
def measure_loss(bench):
    """All processes of the daemon are killed or suspended while `optodrive push` shows a train."""
    with running_daemon() as (board, daemon):
        suspended_s = [lose(bench, board, daemon, signal.SIGSTOP) for _ in range(2)]
    killed_s = []
    for _ in range(2):
        with running_daemon() as (board, daemon):
            killed_s.append(lose(bench, board, daemon, signal.SIGKILL))
    for what, times_s in (("killed", killed_s), ("suspended", suspended_s)):
        dark_s, ended_s = zip(*times_s, strict=True)
        yield Row(f"every process {what} to dark, with a lease of 100 ms", to_ms(dark_s), aim=101.0)
        yield Row(f"every process {what} to the end of `optodrive push`", to_ms(ended_s), aim=5000.0)


def lose(bench, board, daemon, number):
    """Send a signal to every process of a daemon.

    Return the times until dark and until the end of the command, s.
    """
    arm_when_ready(daemon)
    board.forget()
    frames = bench.make_folder() / "frames.json"
    frames.write_text(json.dumps(long_train(seconds=30.0)))
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN}
    command = [OPTODRIVE, "push", frames, "--url", daemon.url]
    push = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for(lambda: len(board.of("pulse")) > 3, "pulses")
    lost_us, lost_s = board.now_us(), time.monotonic()
    pids = [daemon.process.pid, *daemon.list_children()]
    for pid in pids:
        os.kill(pid, number)
    push.wait()
    ended_s = time.monotonic() - lost_s
    wait_for_dark_us(board)
    for pid in reversed(pids):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    return find_dark_s(board, lost_us), ended_s


@measurement("end")
def measure_end(bench):
    values_s = []
    for _ in range(2):
        with running_daemon() as (_, daemon):
            os.kill(daemon.find_process("planner"), signal.SIGSTOP)
            values_s.append(end(daemon))
    name = "SIGTERM to the end of a daemon with a suspended planner"
    yield Row(name, to_ms(values_s), aim=1e3 * END_GRACE_S)


# --- boards ----------------------------------------------------------------------------------------------------------


@measurement("board")
def measure_board(bench):
    """Measure the exchanges of a session's clock. That of one of several boards has four per second."""
    folder = bench.make_folder()
    board = Board(folder)
    try:
        requirements = build_board_requirements(load_config("display-16"))
        session = BoardSession(SerialPort(str(board.port), 1_000_000), MonotonicClock(), requirements, True)
        session.connect()
        until_s = time.monotonic() + 3.0
        while time.monotonic() < until_s:
            session.step(0.002, renew_lease=False)
        trips_s = [width_s for width_s, *_ in session._clock_sync._samples]
        session.close()
    finally:
        board.stop()
    yield Row("round trip to a board on a pseudo-terminal", to_ms(trips_s), aim=50.0)


@measurement("boards")
def measure_boards(bench):
    boards = SeveralBoards(bench.make_folder(), 2)
    try:
        boards.arm()
        time.sleep(5.0)  # until the rates of the clocks are known
        skews_s = np.concatenate([boards.draw_frame() for _ in range(4)])[:, 0]
        stops_s = [boards.measure_stop_s() for _ in range(4)]
        boards.arm()
        boards.start_trains()
        lost, left = boards.boards
        lost.process.kill()
        lost_s = time.monotonic()
        lost.process.wait()
        dark_s = boards.began_s[1] + boards.clocks[1].find_true_s(1e-6 * wait_for_dark_us(left)) - lost_s
    finally:
        boards.stop()
    skew_max_us = 1e6 * load_config("display-437").limits.stage_skew_max_s
    yield Row("skew of gate edges of two boards", (1e6 * np.abs(skews_s)).tolist(), "µs", skew_max_us)
    yield Row("STOP to dark of two boards", to_ms(stops_s), aim=STOP_MAX_MS)
    name = "loss of one board to dark of the other, with a lease of 300 ms"
    yield Row(name, 1e3 * dark_s, aim=320.0)


OPTIONS = {"--only": {"action": "append", "choices": tuple(MEASUREMENTS), "help": "a measurement; may be repeated"}}


def measure(only=None):
    with ExitStack() as stack:
        bench = Bench(stack)
        for name in only or MEASUREMENTS:
            sleeper, begin_s = Sleeper(), time.monotonic()
            try:
                with time_limit(LIMIT_S):
                    rows = list(MEASUREMENTS[name](bench))
            except Exception as error:
                traceback.print_exc()
                rows = [Row(name, [], note=f"failed: {type(error).__name__}: {error}")]
            late_s = sleeper.finish()
            print(f"{time.monotonic() - begin_s:5.1f} s  {name}", file=sys.stderr, flush=True)
            for row in rows:
                row.name, row.late_s = name, late_s
                yield row
