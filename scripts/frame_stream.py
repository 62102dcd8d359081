"""Benchmark of full frames over a long time: a WebSocket streams 16 frames/s while two busy loops use the cores.

It counts underruns and lapses of the lease in the board's log, and reads the memory of each process at start and end.
"""

import fcntl
import json
import os
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress

import httpx
import numpy as np
from measuring import Row, running_daemon, to_ms
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from process_memory import list_processes, read_memory_mib  # of the tests
from rig import TOKEN

NAME, PIXELS, FULL_HZ = "display-1511", 1511, 16.0
BUSY_LOOPS = 2
MEMORY_SETTLING_S = 30.0
"""Time after which the memory at the start is read: buffers and records have their usual size then."""
PIPE_BYTES = 1 << 20


class LogCounter:
    """Counts a board's events from a FIFO in place of its log, which would grow by 50 MB per hour."""

    def __init__(self, path):
        os.mkfifo(path)
        self.counts = Counter()
        self._file = os.open(path, os.O_RDWR)  # open for writing too: no end while the board has not opened it
        fcntl.fcntl(self._file, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._thread = threading.Thread(target=self._count, daemon=True)
        self._thread.start()

    def _count(self):
        rest = b""
        while True:
            lines = (rest + os.read(self._file, 1 << 16)).split(b"\n")
            rest = lines.pop()
            for line in lines:
                event = json.loads(line)
                kind = event["event"]
                self.counts[{"fault": f"fault {event.get('fault')}", "state": event.get("state")}.get(kind, kind)] += 1


class FrameStream:
    """A WebSocket that sends a travelling wave on every pixel. It connects and arms again after an interruption."""

    def __init__(self, daemon, duration_s):
        self._daemon, self._end_s = daemon, time.monotonic() + duration_s
        rows = np.arange(PIXELS)
        waves = (600 * (1 + np.sin(0.3 * k + rows / 4)) for k in range(64))
        self._bodies = [np.where(wave < 50, 0, wave).astype("<u2").tobytes() for wave in waves]
        self._sent = 0
        self.statuses, self.errors = Counter(), Counter()
        self.first_byte_s, self.first_light_s, self.lead_s = [], [], []

    def run(self):
        """Stream until the end."""
        while time.monotonic() < self._end_s:
            try:
                self._daemon.client.post("/v1/disarm")
                self._daemon.client.post("/v1/arm").raise_for_status()
                self._stream()
            except (OSError, httpx.HTTPError, WebSocketException) as error:
                self.errors[type(error).__name__] += 1
                time.sleep(1.0)

    def stop(self):
        """End the stream before its time."""
        self._end_s = 0.0

    def _stream(self):
        url = self._daemon.url.replace("http", "ws") + "/v1/stream"
        header = {"Authorization": f"Bearer {TOKEN}"}
        with connect(url, additional_headers=header, proxy=None, compression=None) as link:
            reader = threading.Thread(target=self._read, args=(link,))
            reader.start()
            next_s, refused = time.monotonic(), self.statuses["refused"]
            while time.monotonic() < self._end_s:
                if self.statuses["refused"] > refused:  # the board is no longer armed
                    break
                link.send(struct.pack("<4sI", b"ODF1", self._sent) + self._bodies[self._sent % len(self._bodies)])
                self._sent += 1
                next_s = max(next_s + 1 / FULL_HZ, time.monotonic())
                time.sleep(max(0.0, next_s - time.monotonic()))
            time.sleep(0.5)
            link.close()
            reader.join()

    def _read(self, link):
        with suppress(WebSocketException):
            for text in link:
                result = json.loads(text)
                self.statuses[result["status"]] += 1
                latency = result.get("latency") or {}
                if result["status"] in ("done", "superseded") and latency.get("first_light_s") is not None:
                    self.first_byte_s.append(latency["first_byte_s"])
                    self.first_light_s.append(latency["first_light_s"])
                    self.lead_s.append(latency["first_light_s"] - latency["first_byte_s"])


def read_memory(daemon):
    """Return the proportional memory of each process of a daemon, MiB by its name."""
    return {name: read_memory_mib(pid)[0] for name, pid in list_processes(daemon.process.pid).items()}


def measure_full_frames(duration_s):
    """Stream full frames for a time beside busy loops. Yield the rows."""
    logs, loops = [], []
    with running_daemon(NAME, prepare=lambda path: logs.append(LogCounter(path))) as (_, daemon):
        stream = FrameStream(daemon, duration_s)
        try:
            loops += [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(BUSY_LOOPS)]
            thread = threading.Thread(target=stream.run)
            thread.start()
            time.sleep(min(MEMORY_SETTLING_S, 0.2 * duration_s))
            memory = {"start": read_memory(daemon)}
            thread.join()
            state = daemon.state()
            memory["end"] = read_memory(daemon)
        finally:
            for loop in loops:
                loop.kill()
                loop.wait()
    name, events = (
        f"full frames, {FULL_HZ:g}/s for {duration_s / 60:g} min beside {BUSY_LOOPS} busy loops",
        logs[0].counts,
    )
    yield f"{name}: frames answered", sum(stream.statuses.values()) - stream.statuses["planned"], "1"
    for key, count in stream.statuses.items():
        yield f"{name}: frames {key}", count, "1"
    for key, count in stream.errors.items():
        yield f"{name}: connections lost, {key}", count, "1"
    yield Row(f"{name}: arrival to first byte", to_ms(stream.first_byte_s))
    yield Row(f"{name}: arrival to first light", to_ms(stream.first_light_s))
    yield Row(f"{name}: lead of first byte over light", to_ms(stream.lead_s))
    faults = {key: count for key, count in events.items() if key.startswith("fault")}
    yield f"{name}: pulses in the board's log", events["pulse"], "1"
    yield f"{name}: underruns", events["HOLD"], "1"
    yield f"{name}: lapses of the lease", faults.pop("fault LINK", 0), "1"
    yield f"{name}: other faults", sum(faults.values()), "1"
    yield f"{name}: longest stall of the link", state["link"]["longest_stall_ms"], "ms"
    for when, values in memory.items():
        for key, mib in values.items():
            yield f"{name}: memory of {key} at the {when}", mib, "MiB"
        yield f"{name}: memory of all at the {when}", sum(values.values()), "MiB"
