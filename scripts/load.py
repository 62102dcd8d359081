"""Load test of a daemon with a simulated board: clients push frames and poll the state, with a STOP every few seconds.

Half of the pushing clients send dry runs, the others send frames that supersede waiting ones. The clients run at fixed
rates in one process, STOP is sent by another. The time to gate off is taken from the board's log: the last edge minus
the log's clock when STOP was sent. All processes share this computer, so other load on it affects the results.
"""

import argparse
import asyncio
import json
import os
import random
import re
import statistics
import subprocess
import sys
import time
from collections import Counter

import httpx
from measuring import Sleeper, compute_percentile, running_daemon

from process_memory import read_memory_mib  # of the tests
from rig import TOKEN

HEADERS = {"Authorization": f"Bearer {TOKEN}"}
STOP_EVERY_S = 3.0
GROWTH_MAX_MB = 30.0
"""Growth of memory from the first third to the last that counts as a leak; records of plans are bounded."""
STOP_P99_MAX_S = 0.05


class HttpClient:
    """A minimal HTTP connection, which costs little CPU time compared with the daemon."""

    def __init__(self, url):
        self._host, self._port = url.removeprefix("http://").split(":")
        self._reader = self._writer = None

    async def request(self, method, path, body=b""):
        """Send a request, discard the body of the response, and return its status."""
        if self._writer is None:
            self._reader, self._writer = await asyncio.open_connection(self._host, int(self._port))
        head = f"{method} {path} HTTP/1.1\r\nHost: {self._host}\r\nAuthorization: Bearer {TOKEN}\r\n"
        self._writer.write(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
        answer = (await self._reader.readuntil(b"\r\n\r\n")).decode().lower()
        length = re.search(r"content-length: (\d+)", answer)
        if length:
            await self._reader.readexactly(int(length[1]))
        return int(answer.split()[1])

    async def read_more(self):
        """Return further bytes of a streamed response."""
        return await self._reader.read(65536)

    def close(self):
        if self._writer is not None:
            self._writer.close()


class ClientPool:
    """The pushing and polling clients, which run in their own process for the requested time."""

    def __init__(self, options):
        self._options = options
        self._end_s = time.monotonic() + 60 * options.minutes
        self.answers = Counter()
        self.trips = {"push": [], "dry run": [], "state": [], "telemetry": []}

    async def run(self):
        paths = httpx.get(f"{self._options.client_url}/openapi.json", headers=HEADERS).json()["paths"]
        watchers = range(self._options.watchers)
        listening = [k for k in watchers if k % 2 and "/v1/telemetry" in paths]
        await asyncio.gather(
            *(self._push_frames(k) for k in range(self._options.clients)),
            *(self._read_telemetry() if k in listening else self._poll_state() for k in watchers),
        )
        print(json.dumps({"answers": self.answers, "trips": self.trips}))

    def _is_over(self):
        return time.monotonic() >= self._end_s

    async def _repeat(self, period_s, kind, send):
        client = HttpClient(self._options.client_url)
        await asyncio.sleep(random.random() * period_s)
        while not self.trips[kind] or not self._is_over():  # once at least
            begin_s = time.monotonic()
            self.answers[await send(client)] += 1
            self.trips[kind].append(time.monotonic() - begin_s)
            await asyncio.sleep(max(0.0, begin_s + period_s - time.monotonic()))
        client.close()

    async def _push_frames(self, number):
        rng = random.Random(number)
        dry = number % 2 == 0
        path = f"/v1/plans?{'dry_run' if dry else 'newest'}=true"

        def send(client):
            targets = {str(pixel): rng.uniform(30, 90) for pixel in rng.sample(range(400), self._options.pixels)}
            frame = {"show_at_s": 0, "duration_s": 60, "target_um": targets}
            return client.request("POST", path, json.dumps({"frames": [frame]}).encode())

        await self._repeat(self._options.push_s, "dry run" if dry else "push", send)

    async def _poll_state(self):
        await self._repeat(self._options.watch_s, "state", lambda client: client.request("GET", "/v1/state"))

    async def _read_telemetry(self):
        client = HttpClient(self._options.client_url)
        self.answers[await client.request("GET", "/v1/telemetry")] += 1
        while not self._is_over() and await client.read_more():
            pass
        client.close()


class StopTest:
    """The STOP requests, sent from this process, and the measurements."""

    def __init__(self, board, daemon, options):
        self._board, self._daemon, self._client = board, daemon, daemon.client
        self._end_s = time.monotonic() + 60 * options.minutes
        self.stop_s, self.gate_off_s, self.memory_mb, self.wake_delays_s = [], [], [], []
        self.underruns = self.faults = self.stall_ms = 0
        arguments = [
            f"--{name.replace('_', '-')}={value}" for name, value in vars(options).items() if name != "client_url"
        ]
        self._client.post("/v1/arm").raise_for_status()
        self._sleeper = Sleeper()
        self._client_process = subprocess.Popen(
            [sys.executable, __file__, *arguments, f"--client-url={daemon.url}"], stdout=subprocess.PIPE, text=True
        )

    def run(self):
        """Repeat until the end: play pulses, send STOP while they play, arm again."""
        while not self.stop_s or time.monotonic() < self._end_s:  # once at least
            train = {"pixel": 200, "start_s": 0, "duration_s": 9, "pulse_width_s": 0.01, "gap_s": 0.01, "power_w": 1.0}
            self._client.post("/v1/plans", json={"trains": [train]})
            time.sleep(random.uniform(0.1, 1.0) * STOP_EVERY_S)
            self._stop()
            self.memory_mb.append(read_memory_mib(self._daemon.process.pid)[1])
            state = self._client.get("/v1/state").json()
            self.underruns = state["board"]["underruns"]
            self.stall_ms = state["link"]["longest_stall_ms"]
            if state["board"]["fault"]:
                self.faults += 1
                self._client.post("/v1/disarm")
            self._client.post("/v1/arm")
        self.wake_delays_s = self._sleeper.finish()
        output, _ = self._client_process.communicate()
        results = json.loads(output)
        self.answers, self.trips = Counter(results["answers"]), results["trips"]

    def _stop(self):
        sent_us, begin_s = self._wait_for_gate_edge_us(), time.monotonic()
        response = self._client.post("/v1/stop")
        self.stop_s.append(time.monotonic() - begin_s)
        response.raise_for_status()
        edges = self._board.of("gate")
        if edges and edges[-1]["on"]:
            raise SystemExit("scripts/load: the gate is on after the response to STOP")
        if edges and sent_us is not None:
            self.gate_off_s.append(max(0.0, 1e-6 * (edges[-1]["t_us"] - sent_us)))

    def _wait_for_gate_edge_us(self):
        """Wait for an edge of the gate and return its time on the board's clock, µs, or None if the gate stays off."""
        self._board.forget()
        end_s = time.monotonic() + 0.3
        while time.monotonic() < end_s:
            if edges := self._board.of("gate"):
                return edges[-1]["t_us"]
            time.sleep(0.0005)
        return None

    def close(self):
        process = self._client_process
        if process.poll() is None:
            process.terminate()
        process.wait()
        process.stdout.close()


def format_percentiles(values):
    """Format the count, median and 99th percentile."""
    p50_ms, p99_ms = (1e3 * compute_percentile(values, share) for share in (0.5, 0.99))
    return f"{len(values)} times, p50 {p50_ms:.1f} ms, p99 {p99_ms:.1f} ms"


def print_report(stop_test, seconds):
    """Print the measurements, and return the failures."""
    for kind, trips in stop_test.trips.items():
        if trips:
            print(f"{kind:10} answered {format_percentiles(trips)}")
    print(f"answers    {sum(stop_test.answers.values()) / seconds:.0f} per second, by status {dict(stop_test.answers)}")
    print(f"STOP       answered {format_percentiles(stop_test.stop_s)}")
    print(f"gate off   in the board's log, from gate on: {format_percentiles(stop_test.gate_off_s)}")
    third = max(1, len(stop_test.memory_mb) // 3)
    first, last = statistics.median(stop_test.memory_mb[:third]), statistics.median(stop_test.memory_mb[-third:])
    memory_max_mb = max(stop_test.memory_mb)
    print(f"memory     {first:.1f} MB in the first third, {last:.1f} MB in the last, max {memory_max_mb:.1f} MB")
    print(f"underruns  {stop_test.underruns}; faults after STOP: {stop_test.faults}")
    print(f"engine     longest stall of its loop {stop_test.stall_ms:.0f} ms")
    print(
        f"sleeper    lateness of a sleeping process {format_percentiles(stop_test.wake_delays_s)}, "
        f"max {1e3 * max(stop_test.wake_delays_s):.0f} ms"
    )
    print(f"computer   load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores, including these clients")
    failures = []
    if stop_test.underruns:
        failures.append(f"{stop_test.underruns} underruns")
    if last - first > GROWTH_MAX_MB:
        failures.append(f"memory grew by {last - first:.0f} MB")
    if any(int(status) >= 500 for status in stop_test.answers):
        failures.append("responses with status 500 or above")
    return failures


def main():
    parser = argparse.ArgumentParser(prog="scripts/load", description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--clients", type=int, default=50, help="clients that push frames")
    parser.add_argument("--watchers", type=int, default=20, help="clients that poll the state")
    parser.add_argument("--push-s", type=float, default=1.0, help="period of each pushing client")
    parser.add_argument("--watch-s", type=float, default=0.1, help="period of each polling client")
    parser.add_argument("--pixels", type=int, default=20, help="pixels per frame")
    parser.add_argument("--config", default="display-437")
    parser.add_argument("--client-url", metavar="URL", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.client_url:
        asyncio.run(ClientPool(options).run())
        return 0
    with running_daemon(options.config) as (board, daemon):
        stop_test = StopTest(board, daemon, options)
        try:
            stop_test.run()
        finally:
            stop_test.close()
    failures = print_report(stop_test, 60 * options.minutes)
    p99_s = compute_percentile(stop_test.stop_s, 0.99)
    if p99_s >= STOP_P99_MAX_S:
        print(f"slow       STOP answered p99 {1e3 * p99_s:.0f} ms, expected below {1e3 * STOP_P99_MAX_S:.0f} ms")
    if failures:
        print(f"scripts/load: {'; '.join(failures)}", file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
