"""The reported latency: its error against the caller's instants and the board's own log.

Frames go to the daemon at 5 to 60 per second over REST, the WebSocket, the Python client and the page in Chromium. Its
true latency counts to the light, by the board's log, from an instant between those before and after it was sent.
"""

import http.client
import json
import re
import socket
import tempfile
import threading
import time
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path

from measuring import Row, to_ms
from websockets.sync.client import connect

from optodrive.client import Display
from rig import PATIENT_LEAD_S, TOKEN, running, wait_for  # of the tests
from window import PageVisit, launch_chromium

RATES_HZ = (5, 10, 20, 30, 60)
FRAMES, PIXELS, HEIGHT_UM = 20, 40, 60
"""Frames per rate, and what each shows: more than fits between two of them, so that one follows the other's light."""
OPTIONS = {"--frames": {"type": int, "default": FRAMES, "help": "frames per rate and way"}}
BEARER = {"Authorization": f"Bearer {TOKEN}"}
PAGE_SCRIPT = """async ([bodies, periodMs]) => {
    const { call } = await import("/page/api.js");
    const begin = performance.now();
    return Promise.all(bodies.map(async (body, k) => {
        await new Promise((resolve) => setTimeout(resolve, begin + k * periodMs - performance.now()));
        return (await call("POST", `/v1/plans?newest=true&name=f${k}`, { body })).plan;
    }));
}"""


@dataclass
class Frame:
    """A frame with the monotonic times before and after it was sent, and the report of its plan."""

    target_um: dict
    before_s: float = 0.0
    after_s: float = 0.0
    report: dict = field(default_factory=dict)

    @contextmanager
    def sending(self):
        self.before_s = time.monotonic()
        yield
        self.after_s = time.monotonic()

    @property
    def body(self):
        return {"frames": [{"show_at_s": 0, "duration_s": 1, "target_um": self.target_um}]}

    def find_error_s(self, light_s):
        """Return the error of the reported latency, given the time of the light by the board's log."""
        arrived_s = light_s - self.report["latency"]["first_light_s"]
        return max(0.0, self.before_s - arrived_s, arrived_s - self.after_s)


def pace(frames, rate_hz):
    """Yield each frame when it is due."""
    next_s = time.monotonic()
    for frame in frames:
        time.sleep(max(0.0, next_s - time.monotonic()))
        yield frame
        next_s += 1.0 / rate_hz


def fetch_reports(daemon, frames, plans):
    for frame, plan in zip(frames, plans, strict=True):
        frame.report = daemon.finished(plan)


def send_over_rest(daemon, frames, rate_hz):
    link, plans = http.client.HTTPConnection(daemon.client.base_url.host, daemon.client.base_url.port), []
    for frame in pace(frames, rate_hz):
        with frame.sending():
            link.request("POST", "/v1/plans?newest=true", json.dumps(frame.body), BEARER)
        plans.append(json.load(link.getresponse())["plan"])
    fetch_reports(daemon, frames, plans)


def send_over_socket(daemon, frames, rate_hz):
    with connect(f"{daemon.url.replace('http', 'ws')}/v1/stream", additional_headers=BEARER, proxy=None) as stream:

        def read():
            while not all(frame.report for frame in frames):
                result = json.loads(stream.recv())
                if result["status"] != "planned":
                    frames[result["frame"]].report = result

        reader = threading.Thread(target=read)
        reader.start()
        for frame in pace(frames, rate_hz):
            with frame.sending():
                stream.send(json.dumps({"target_um": frame.target_um}))
        reader.join()


def send_over_client(daemon, frames, rate_hz):
    with Display(daemon.url, TOKEN) as display, display.stream() as stream:
        for frame in pace(frames, rate_hz):
            with frame.sending():
                stream.send({int(pixel): height_um for pixel, height_um in frame.target_um.items()})
        stream.wait()
        for result in stream.results():
            if result.is_final:
                frames[result.frame].report = result.model_dump()


class Relay:
    """A TCP relay in front of a daemon that notes when a browser's frames leave for it. The browser itself cannot tell.

    frames: noted when the request that names their number passes
    """

    def __init__(self, daemon, frames):
        self._address = daemon.client.base_url.host, daemon.client.base_url.port
        self._frames = frames
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self):
        self._listener.close()

    def _accept(self):
        with suppress(OSError):  # closed
            while True:
                browser, daemon = self._listener.accept()[0], socket.create_connection(self._address)
                for ends in ((browser, daemon), (daemon, browser)):
                    ends[1].setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    threading.Thread(target=self._pump, args=ends, daemon=True).start()

    def _pump(self, source, sink):
        with suppress(OSError), source, sink:
            while data := source.recv(65536):
                found = re.search(rb"^POST /v1/plans\S*name=f(\d+)", data)
                with self._frames[int(found.group(1))].sending() if found else nullcontext():
                    sink.sendall(data)


def send_over_page(daemon, frames, rate_hz):
    relay = Relay(daemon, frames)
    try:
        with launch_chromium() as browser:
            page = PageVisit(browser, relay.url).open()
            plans = page.evaluate(PAGE_SCRIPT, [[frame.body for frame in frames], 1e3 / rate_hz])
    finally:
        relay.close()
    fetch_reports(daemon, frames, plans)


WAYS = {
    "REST": send_over_rest,
    "WebSocket": send_over_socket,
    "Python client": send_over_client,
    "page": send_over_page,
}


def run_daemon(folder):
    """Run a board and a daemon with a lease that a stalled computer outlasts, and the usual lead of streams."""
    return running(folder, [(f"stream_lead_s = {PATIENT_LEAD_S}", "stream_lead_s = 0.03")])


def measure_errors(board, daemon, way, rate_hz, count=FRAMES):
    """Show frames. Return the errors of the reported latencies of those that gave light, s."""
    if daemon.board_state() == "DISARMED":
        daemon.arm()
    board.forget()
    frames = [
        Frame({str((7 * k + pixel) % 437): HEIGHT_UM for pixel in range(0, 11 * PIXELS, 11)}) for k in range(count)
    ]
    WAYS[way](daemon, frames, rate_hz)
    zero_s = float(Path(f"{board.port}.clock").read_text())
    # A browser sends over several connections: its frames may be planned in another order.
    frames.sort(key=lambda frame: int((frame.report.get("plan") or "p0")[1:]))
    executed = [frame.report.get("executed") or 0 for frame in frames]
    lights = wait_for(lambda: len(on := read_gate_on(board)) >= sum(executed) and on, "the log of all pulses")
    errors_s, first = [], 0
    for frame, pulses in zip(frames, executed, strict=True):
        if pulses:
            errors_s.append(frame.find_error_s(zero_s + lights[first] * 1e-6))
        first += pulses
    return errors_s


def read_gate_on(board):
    return [event["t_us"] for event in board.of("gate") if event["on"]]


def measure(frames=FRAMES):
    with tempfile.TemporaryDirectory() as folder, run_daemon(Path(folder)) as (board, daemon):
        for way in WAYS:
            for rate_hz in RATES_HZ:
                errors_s = measure_errors(board, daemon, way, rate_hz, frames)
                yield Row(f"error of a reported latency, {way}, {rate_hz} frames/s", to_ms(errors_s))
