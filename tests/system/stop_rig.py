"""Board, daemon and a show of full frames, which a flood must not darken and a STOP must end."""

import json
import os
import resource
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx

from floods import FLOODS
from rig import PATIENT_LEASE_S, TOKEN, Board, Daemon, wait_for

HERE = Path(__file__).parent
SHORT_INDICATOR_BOARD = (sys.executable, HERE / "short_indicator_board.py")
PIXELS = 437
DESCRIPTORS = 1024
"""Soft limit of open files that systemd gives a service by default."""
FRAME_S = 1.6
"""Time of a frame of the show: 437 pixels of 3.5 ms each keep the beam busy for most of it."""
SHOW_PERIOD_S = 8.0
"""Time between two pushes of a show that is kept running; each takes nineteen seconds, so the queue grows."""


@contextmanager
def limited_descriptors(count=DESCRIPTORS):
    """Give the processes started meanwhile a soft limit of open files."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(count, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def encode_message(kind, **fields):
    """Encode a message to the link process as the protocol states it: two lengths and a JSON object."""
    header = json.dumps({"kind": kind, **fields}).encode()
    return struct.pack("<II", 8 + len(header), len(header)) + header


class LogTail:
    """Reads a board's log piece by piece."""

    def __init__(self, path):
        self._path = path
        self._offset = 0
        self.events = []

    def read(self):
        """Append the events logged since the last call and return them."""
        if not self._path.exists():
            return []
        with self._path.open("rb") as file:
            file.seek(self._offset)
            data = file.read()
        data = data[: data.rfind(b"\n") + 1]
        self._offset += len(data)
        fresh = [json.loads(line) for line in data.splitlines()]
        self.events += fresh
        return fresh

    def find(self, condition, begin, what):
        """Wait for the first event from index `begin` on that meets the condition."""

        def look():
            self.read()
            return next((event for event in self.events[begin:] if condition(event)), None)

        return wait_for(look, what)


class FloodProcess:
    """A flood of floods.py in its own process.

    workers: in place of the flood's own number; interval_s: between two requests of a worker, if the flood knows it
    """

    def __init__(self, name, url, tokens, pixels=PIXELS, workers=None, interval_s=0.0):
        self._waits = FLOODS[name].waits
        command = [sys.executable, HERE / "floods.py", name, *(() if workers is None else (str(workers),))]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        base = httpx.URL(url)
        self._send({"host": base.host, "port": base.port, "tokens": tokens, "pixels": pixels, "interval_s": interval_s})
        assert self.process.stdout.readline() == "ready\n", f"the flood {name} did not begin"

    def _send(self, value):
        self.process.stdin.write(json.dumps(value) + "\n")
        self.process.stdin.flush()

    @contextmanager
    def triggered(self):
        """Let a flood that waits run once, and be over at the end of the block."""
        self._send("go")
        yield
        if self._waits:
            assert self.process.stdout.readline() == "over\n"

    def finish(self):
        """End the flood and return the outcomes that it counted."""
        output, _ = self.process.communicate()
        assert self.process.returncode == 0
        return json.loads(output)


def build_http_sender(url, method, path):
    """Return a function that sends a request on a fresh connection and returns when its answer began.

    url: an httpx.URL; the answer must be 200
    """
    request = (
        f"{method} {path} HTTP/1.1\r\nHost: {url.host}:{url.port}\r\nAuthorization: Bearer {TOKEN}\r\n"
        "Content-Length: 0\r\nConnection: close\r\n\r\n"
    ).encode()

    def send():
        with socket.create_connection((url.host, url.port)) as link:
            link.sendall(request)
            answer = link.recv(4096)
            answered_s = time.monotonic()
            assert answer.startswith(b"HTTP/1.1 200"), answer
            return answered_s

    return send


def build_socket_sender(path):
    """Return a function that sends STOP over the link process's own socket and returns when its answer came."""
    messages = encode_message("hello", role="operator") + encode_message("stop", id=1)

    def send():
        with socket.socket(socket.AF_UNIX) as link:
            link.connect(path)
            link.sendall(messages)
            received = b""
            while b'"result"' not in received:
                data = link.recv(1 << 16)
                assert data, "the link process closed the connection"
                received += data
            return time.monotonic()

    return send


class StopRig:
    """A board with a short indicator, a daemon on it, and shows of full frames.

    show_frames: frames of one show, each of FRAME_S
    """

    def __init__(self, folder, lease_s=PATIENT_LEASE_S, options="", show_frames=12):
        self.board = Board(folder, program=SHORT_INDICATOR_BOARD, limits=f"lease_ms = {lease_s * 1e3:.0f}\n")
        self.tail = LogTail(self.board.log)
        try:
            self._zero_s = float(wait_for(lambda: self._read_clock(), "the board's clock"))
            line = f"lease_s = {lease_s}"
            with limited_descriptors():
                section = ((line, f"{line}\n[daemon]\n{options}\n#"),) if options else ()
                self.daemon = Daemon(folder, self.board.port, replace=section, lease_s=lease_s)
        except BaseException:
            self.board.stop()
            raise
        self.client = httpx.Client(base_url=self.daemon.url, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=None)
        heights = ",".join(["60"] * PIXELS)
        frames = [
            f'{{"show_at_s":{FRAME_S * k},"duration_s":{FRAME_S},"target_um":[{heights}]}}' for k in range(show_frames)
        ]
        self._show = f'{{"frames":[{",".join(frames)}]}}'
        url = self.daemon.client.base_url
        path = os.path.realpath(folder / "optodrive" / f"daemon-{url.port}") + "/link.sock"
        self.senders = {"http": build_http_sender(url, "POST", "/v1/stop"), "socket": build_socket_sender(path)}

    def _read_clock(self):
        path = Path(f"{self.board.port}.clock")
        return path.exists() and path.read_text().strip()

    def to_host_s(self, event):
        """Return the host's monotonic time of an event of the board's log."""
        return self._zero_s + 1e-6 * event["t_us"]

    def arm(self):
        """Arm the board, after a fault too."""
        if self.client.post("/v1/arm").status_code != 200:
            self.client.post("/v1/disarm")
            self.client.post("/v1/arm").raise_for_status()

    def start_show(self):
        """Arm, push a show, wait for light or a fault, and return the index of the show's first event."""
        self.arm()
        self.tail.read()
        begin = len(self.tail.events)
        response = self.client.post("/v1/plans", content=self._show)
        assert response.status_code == 201, response.text
        self.tail.find(lambda event: is_gate_on(event) or is_unarmed(event), begin, "light")
        return begin

    def find_darkness(self, begin):
        """Return the faults and underruns logged from index `begin` on."""
        self.tail.read()
        return [
            event.get("fault") or "UNDERRUN"
            for event in self.tail.events[begin:]
            if event["event"] == "fault" or is_underrun(event)
        ]

    @contextmanager
    def running_show(self):
        """Keep a show running, push by push, and yield the index of its first event. STOP at the end."""
        begin, is_over = self.start_show(), threading.Event()

        def push():
            while not is_over.wait(SHOW_PERIOD_S):
                with suppress(httpx.HTTPError):
                    self.client.post("/v1/plans", content=self._show)

        thread = threading.Thread(target=push)
        thread.start()
        try:
            yield begin
        finally:
            is_over.set()
            thread.join()
            with suppress(httpx.HTTPError):
                self.client.post("/v1/stop")

    def watch_show(self, begin, pulses):
        """Let the show that began at an event emit a number of pulses. Return the events that end it."""

        def look():
            self.tail.read()
            shown = self.tail.events[begin:]
            ends = [event for event in shown if is_unarmed(event) or event["event"] == "fault" or is_underrun(event)]
            return ends or (sum(map(is_gate_on, shown)) >= pulses and "lit")

        found = wait_for(look, f"{pulses} pulses")
        return [] if found == "lit" else found

    def close(self):
        """End daemon and board."""
        self.client.close()
        try:
            self.daemon.stop()
        except subprocess.TimeoutExpired:
            self.daemon.process.kill()
            raise
        finally:
            self.board.stop()


def is_gate_on(event):
    """Return whether an event is an edge to gate on."""
    return event["event"] == "gate" and event["on"]


def is_unarmed(event):
    """Return whether an event is a change to a state without light."""
    return event["event"] == "state" and event["state"] in ("DISARMED", "FAULT")


def is_underrun(event):
    """Return whether an event is a wait for points that have not come."""
    return event["event"] == "state" and event["state"] == "HOLD"
