"""Board, daemon and a show of full frames, with the time from sending STOP to dark according to the board's log."""

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
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import httpx

from rig import PATIENT_LEASE_S, TOKEN, Board, Daemon, read_role_tokens, wait_for

HERE = Path(__file__).parent
SHORT_INDICATOR_BOARD = (sys.executable, HERE / "short_indicator_board.py")
PIXELS = 437
DESCRIPTORS = 1024
"""Soft limit of open files that systemd gives a service by default."""
FLOOD_LEASE_S = 0.3
"""Lease under a flood. Bytes to a board on a pseudo-terminal pass a thread of the kernel without real-time priority,
which a full computer delays by up to 0.15 s; those to a board on USB do not.
"""
ANSWER_MAX_S = 60.0
"""A STOP without an answer for this time counts as one."""
CALL_MAX_S = 15.0
"""Longest wait for the other answers of the show's own caller."""
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

    def find(self, condition, begin, what, patience_s=20.0):
        """Wait for the first event from index `begin` on that meets the condition."""

        def look():
            self.read()
            return next((event for event in self.events[begin:] if condition(event)), None)

        return wait_for(look, what, patience_s)


class FloodProcess:
    """A flood of floods.py in its own process.

    workers: in place of the flood's own number; interval_s: between two requests of a worker, if the flood knows it
    """

    def __init__(self, name, url, tokens, pixels=PIXELS, workers=None, interval_s=0.0):
        command = [sys.executable, HERE / "floods.py", name, *(() if workers is None else (str(workers),))]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        base = httpx.URL(url)
        self._send({"host": base.host, "port": base.port, "tokens": tokens, "pixels": pixels, "interval_s": interval_s})
        assert self.process.stdout.readline() == "ready\n", f"the flood {name} did not begin"

    def _send(self, value):
        self.process.stdin.write(json.dumps(value) + "\n")
        self.process.stdin.flush()

    def trigger(self):
        """Let a flood that waits begin."""
        self._send("go")

    def finish(self):
        """End the flood and return the outcomes that it counted."""
        try:
            output, _ = self.process.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
            raise
        assert self.process.returncode == 0
        return json.loads(output)


@dataclass
class FloodResult:
    """What a show and its STOPs met under a flood.

    gate_off_s: from sending STOP to the board's abort; answered_s: from sending STOP to the first byte of its answer
    darkened: faults and underruns that were not STOP's doing; relit: pulses after a STOP and before the next arming
    log: what the daemon wrote to its log meanwhile
    """

    name: str
    gate_off_s: list[float] = field(default_factory=list)
    answered_s: list[float] = field(default_factory=list)
    darkened: list[str] = field(default_factory=list)
    relit: int = 0
    not_begun: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)


def send_stop_over_http(daemon, token):
    """Return a function that sends STOP on a fresh connection and returns when the first byte of the answer came."""
    base = daemon.client.base_url
    request = (
        f"POST /v1/stop HTTP/1.1\r\nHost: {base.host}:{base.port}\r\nAuthorization: Bearer {token}\r\n"
        "Content-Length: 0\r\nConnection: close\r\n\r\n"
    ).encode()

    def send():
        with socket.create_connection((base.host, base.port), timeout=ANSWER_MAX_S) as link:
            link.sendall(request)
            answer = link.recv(4096)
            answered_s = time.monotonic()
            assert answer.startswith(b"HTTP/1.1 200"), answer
            return answered_s

    return send


def send_stop_over_socket(daemon):
    """Return the path of the link process's own socket, and a function that sends STOP there as the one over HTTP."""
    port = daemon.client.base_url.port
    path = os.path.realpath(daemon.config.parent / "optodrive" / f"daemon-{port}") + "/link.sock"
    messages = encode_message("hello", role="operator") + encode_message("stop", id=1)

    def send():
        with socket.socket(socket.AF_UNIX) as link:
            link.settimeout(ANSWER_MAX_S)
            link.connect(path)
            link.sendall(messages)
            received = b""
            while b'"result"' not in received:
                data = link.recv(1 << 16)
                assert data, "the link process closed the connection"
                received += data
            return time.monotonic()

    return path, send


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
        self.client = httpx.Client(
            base_url=self.daemon.url, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=CALL_MAX_S
        )
        heights = ",".join(["60"] * PIXELS)
        frames = [
            f'{{"show_at_s":{FRAME_S * k},"duration_s":{FRAME_S},"target_um":[{heights}]}}' for k in range(show_frames)
        ]
        self._show = f'{{"frames":[{",".join(frames)}]}}'
        self._scheduling = os.sched_getscheduler(0), os.sched_getparam(0)
        with suppress(OSError):  # the time of STOP must not include the wait of this process for a core
            os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
        self.senders = {"http": send_stop_over_http(self.daemon, TOKEN)}
        path, send = send_stop_over_socket(self.daemon)
        if Path(path).exists():
            self.senders["socket"] = send

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
        """Arm, push a show, wait for light, and return the index of the show's first event; None if it did not begin.

        A flood may keep the daemon from answering; the caller counts that.
        """
        for _ in range(2):
            with suppress(httpx.HTTPError, AssertionError):
                self.arm()
                self.tail.read()
                begin = len(self.tail.events)
                if self.client.post("/v1/plans", content=self._show).status_code == 201:
                    self.tail.find(is_gate_on, begin, "light", CALL_MAX_S)
                    return begin
        return None

    def find_darkness(self, begin, end_s=float("inf")):
        """Return the faults and underruns logged from index `begin` on and before a time of the host."""
        self.tail.read()
        return [
            event.get("fault") or "UNDERRUN"
            for event in self.tail.events[begin:]
            if (event["event"] == "fault" or event.get("state") == "HOLD") and self.to_host_s(event) < end_s
        ]

    @contextmanager
    def running_show(self):
        """Keep a show running, push by push, and yield the index of its first event; STOP at the end."""
        begin, is_over = self.start_show(), threading.Event()
        assert begin is not None, "the show did not begin"

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
            self._end_show()

    def find_gap_s(self, begin):
        """Return the longest time without light in the events from index `begin` on, s."""
        self.tail.read()
        on_s = [self.to_host_s(event) for event in self.tail.events[begin:] if is_gate_on(event)]
        return max(after - before for before, after in pairwise(on_s))

    def _end_show(self):
        with suppress(httpx.HTTPError):
            self.client.post("/v1/stop")

    def watch_show(self, result, begin, duration_s):
        """Let the show that began at an event run for a time, note what darkens it, and return whether it is lit."""
        until_s = time.monotonic() + duration_s
        while time.monotonic() < until_s and not self.find_darkness(begin):
            time.sleep(0.05)
        darkened = self.find_darkness(begin)
        if darkened:
            result.darkened += darkened
            self._end_show()
        return not darkened

    def stop_show(self, result, begin, send, trigger):
        """Send STOP to the show that began at an event, and note when the board was dark for good."""
        trigger()
        sent_s = time.monotonic()
        try:
            result.answered_s.append(send() - sent_s)
        except (OSError, AssertionError):
            result.answered_s.append(ANSWER_MAX_S)
        try:
            end = self.tail.find(is_unarmed, begin, "the board to be unarmed", ANSWER_MAX_S)
        except AssertionError:
            result.gate_off_s.append(ANSWER_MAX_S)
            return
        if end["state"] == "FAULT":
            result.darkened += self.find_darkness(begin)
        result.gate_off_s.append(max(0.0, self.to_host_s(end) - sent_s))
        rest = self.tail.events[self.tail.events.index(end) :]
        result.relit += sum(map(is_gate_on, rest))

    def run_flood(self, name, stops=20, seconds=60.0, watch_s=0.0, path="http"):
        """Run a flood over a show that is on already, then STOP it and further shows.

        name: of the flood; "rest" for none. watch_s: time of the first show before its STOP. stops: how many, or as
        many as `seconds` allow; no more once two shows in a row did not begin. Returns the FloodResult.
        """
        result, send = FloodResult(name), self.senders[path]
        begin = self.start_show()
        assert begin is not None, "the first show did not begin, before the flood"
        flood = None if name == "rest" else FloodProcess(name, self.daemon.url, read_role_tokens(self.daemon))
        trigger = flood.trigger if flood else lambda: None
        try:
            until_s, failed, round_s = time.monotonic() + seconds, 0, watch_s
            for k in range(stops):
                if begin is not None and self.watch_show(result, begin, round_s):
                    self.stop_show(result, begin, send, trigger)
                if k + 1 == stops or time.monotonic() > until_s or failed == 2:
                    break
                begin, round_s = self.start_show(), 0.02 + 0.013 * (k % 17)
                failed = failed + 1 if begin is None else 0
                result.not_begun += begin is None
        finally:
            if flood is not None:
                result.counts = flood.finish()
        result.log = self.daemon.errors.read_text().splitlines()
        return result

    def close(self):
        """End daemon and board."""
        os.sched_setscheduler(0, self._scheduling[0], self._scheduling[1])
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
