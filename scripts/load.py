"""Load on a daemon with a simulated board: callers push and watch while a plan runs; every few seconds someone stops.

Of the pushers every second sends dry runs, the others frames that take the place of what has not left. Callers are
paced, in a process of their own; who stops is in another. The gate's end is the board's own: the last edge in its log,
against the log's clock when stop was sent. All of them share this computer, so other work on it shows in the figures.
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
import tempfile
import time
from collections import Counter
from pathlib import Path

import httpx

TOKEN = "a-token-for-a-load"
HEADERS = {"Authorization": f"Bearer {TOKEN}"}
STOP_EVERY_S = 3.0
GROWTH_MAX_MB = 30.0
"""More than this from the first third to the last is a leak; records of plans are kept up to a bound."""
STOP_P99_MAX_S = 0.05


SLEEPER = """
import json, signal, time
late_s, on = [], True
def leave(*_):
    global on
    on = False
signal.signal(signal.SIGTERM, leave)
while on:
    due_s = time.monotonic() + 0.002
    time.sleep(0.002)
    late_s.append(time.monotonic() - due_s)
print(json.dumps(late_s[:: max(1, len(late_s) // 100_000)] + [max(late_s)]))
"""
"""A process that only sleeps: how late it wakes is the computer's doing, and no program's on it."""


class LoadRig:
    """Board and daemon, both processes of their own."""

    def __init__(self, folder, config):
        from optodrive.device.config import locate_shipped

        self.log = folder / "board.jsonl"
        port = folder / "tty"
        self.board = subprocess.Popen(
            [sys.executable, "-m", "optodrive.link.simulator.board_process", "--pty", port, "--log", self.log]
        )
        while not port.exists():
            time.sleep(0.01)
        text = locate_shipped(f"{config}.toml").read_text()
        path = folder / "config.toml"
        path.write_text(re.sub(r'transport = "simulated".*', f'transport = "serial"\nport = "{port}"', text))
        self.daemon = subprocess.Popen(
            [Path(sys.executable).with_name("optodrive"), "serve", "--config", path, "--port", "0"],
            env={**os.environ, "OPTODRIVE_TOKEN": TOKEN, "XDG_RUNTIME_DIR": str(folder)},
            stdout=subprocess.PIPE,
            text=True,
        )
        line = self.daemon.stdout.readline()
        if "http" not in line:
            raise SystemExit("scripts/load: the daemon did not start; its own line above says why")
        self.url = re.search(r"http://[\d.:]+", line)[0]
        self._read_bytes = 0

    def read_memory_mb(self):
        """What the daemon holds in memory."""
        status = Path(f"/proc/{self.daemon.pid}/status").read_text()
        return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1024

    def read_new_events(self):
        """What the board has logged since the last call, whole lines only."""
        with self.log.open() as file:
            file.seek(self._read_bytes)
            text = file.read()
        whole = text[: text.rfind("\n") + 1]
        self._read_bytes += len(whole.encode())
        return [json.loads(line) for line in whole.splitlines()]

    def close(self):
        for process in (self.daemon, self.board):
            process.terminate()
            process.wait(timeout=15)
        self.daemon.stdout.close()


class HttpClient:
    """One connection of plain HTTP, so that callers cost this computer little beside the daemon they load."""

    def __init__(self, url):
        self._host, self._port = url.removeprefix("http://").split(":")
        self._reader = self._writer = None

    async def request(self, method, path, body=b""):
        """The answer's status; its body is read and left."""
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
        """More of an answer that does not end."""
        return await self._reader.read(65536)

    def close(self):
        if self._writer is not None:
            self._writer.close()


class ClientPool:
    """Callers in a process of their own: who push and who watch, for as long as was said."""

    def __init__(self, options):
        self._options = options
        self._end_s = time.monotonic() + 60 * options.minutes
        self.answers = Counter()
        self.trips = {"push": [], "dry run": [], "state": [], "telemetry": []}

    async def run(self):
        paths = httpx.get(f"{self._options.crowd}/openapi.json", headers=HEADERS).json()["paths"]
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
        caller = HttpClient(self._options.crowd)
        await asyncio.sleep(random.random() * period_s)
        while not self._is_over():
            begin_s = time.monotonic()
            self.answers[await send(caller)] += 1
            self.trips[kind].append(time.monotonic() - begin_s)
            await asyncio.sleep(max(0.0, begin_s + period_s - time.monotonic()))
        caller.close()

    async def _push_frames(self, number):
        rng = random.Random(number)
        dry = number % 2 == 0
        path = f"/v1/plans?{'dry_run' if dry else 'newest'}=true"

        def ask(caller):
            targets = {str(pixel): rng.uniform(30, 90) for pixel in rng.sample(range(400), self._options.pixels)}
            frame = {"show_at_s": 0, "duration_s": 60, "target_um": targets}
            return caller.ask("POST", path, json.dumps({"frames": [frame]}).encode())

        await self._repeat(self._options.push_s, "dry run" if dry else "push", ask)

    async def _poll_state(self):
        await self._repeat(self._options.watch_s, "state", lambda caller: caller.ask("GET", "/v1/state"))

    async def _read_telemetry(self):
        caller = HttpClient(self._options.crowd)
        self.answers[await caller.request("GET", "/v1/telemetry")] += 1
        while not self._is_over() and await caller.read_more():
            pass
        caller.close()


class StopTest:
    """Who stops, in this process and with nothing else to do; what is counted."""

    def __init__(self, rig, options):
        self._rig = rig
        self._end_s = time.monotonic() + 60 * options.minutes
        self._client = httpx.Client(base_url=rig.url, headers=HEADERS, timeout=30)
        self.stop_s, self.gate_off_s, self.memory_mb, self.wake_delays_s = [], [], [], []
        self.underruns = self.faults = self.stall_ms = 0
        arguments = [f"--{name.replace('_', '-')}={value}" for name, value in vars(options).items() if name != "crowd"]
        self._client.post("/v1/arm").raise_for_status()
        self._sleeper = subprocess.Popen([sys.executable, "-c", SLEEPER], stdout=subprocess.PIPE, text=True)
        self._client_process = subprocess.Popen(
            [sys.executable, __file__, *arguments, f"--crowd={rig.url}"], stdout=subprocess.PIPE, text=True
        )

    def run(self):
        """Until the time is over: a second's pulses, a stop in the midst of them, arm again."""
        while time.monotonic() < self._end_s:
            train = {"pixel": 200, "start_s": 0, "duration_s": 9, "pulse_width_s": 0.01, "gap_s": 0.01, "power_w": 1.0}
            self._client.post("/v1/plans", json={"trains": [train]})
            time.sleep(random.uniform(0.1, 1.0) * STOP_EVERY_S)
            self._stop()
            self.memory_mb.append(self._rig.memory_mb())
            state = self._client.get("/v1/state").json()
            self.underruns = state["board"]["underruns"]
            self.stall_ms = state["link"]["longest_stall_ms"]
            if state["board"]["fault"]:
                self.faults += 1
                self._client.post("/v1/disarm")
            self._client.post("/v1/arm")
        self._sleeper.terminate()
        self.wake_delays_s = json.loads(self._sleeper.communicate(timeout=60)[0])
        told, _ = self._client_process.communicate(timeout=60)
        crowd = json.loads(told)
        self.answers, self.trips = Counter(crowd["answers"]), crowd["trips"]

    def _stop(self):
        sent_us, begin_s = self._wait_for_gate_edge_us(), time.monotonic()
        response = self._client.post("/v1/stop")
        self.stop_s.append(time.monotonic() - begin_s)
        response.raise_for_status()
        edges = [event for event in self._rig.read_new_events() if event["event"] == "gate"]
        if edges and edges[-1]["on"]:
            raise SystemExit("scripts/load: STOP was answered, and the gate is on")
        if edges and sent_us is not None:
            self.gate_off_s.append(max(0.0, 1e-6 * (edges[-1]["t_us"] - sent_us)))

    def _wait_for_gate_edge_us(self):
        """The board's clock now, from the newest line of its log; None where it stays dark."""
        self._rig.read_new_events()
        end_s = time.monotonic() + 0.3
        while time.monotonic() < end_s:
            edges = [event for event in self._rig.read_new_events() if event["event"] == "gate"]
            if edges:
                return edges[-1]["t_us"]
            time.sleep(0.0005)
        return None

    def close(self):
        self._client.close()
        for process in (self._client_process, self._sleeper):
            if process.poll() is None:
                process.terminate()
            process.wait(timeout=15)
            process.stdout.close()


def compute_percentile_ms(values, share):
    ordered = sorted(values)
    return 1e3 * ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")


def format_percentiles(values):
    return f"{len(values)} times, p50 {compute_percentile_ms(values, 0.5):.1f} ms, p99 {compute_percentile_ms(values, 0.99):.1f} ms"


def print_report(stop_test, seconds):
    """Print the figures; what was wrong in them."""
    for what, trips in stop_test.trips.items():
        if trips:
            print(f"{what:10} answered {format_percentiles(trips)}")
    print(f"answers    {sum(stop_test.answers.values()) / seconds:.0f} a second, by status {dict(stop_test.answers)}")
    print(f"STOP       answered {format_percentiles(stop_test.stop_s)}")
    print(f"gate off   by the board's log, while lit: {format_percentiles(stop_test.gate_off_s)}")
    third = max(1, len(stop_test.memory) // 3)
    first, last = statistics.median(stop_test.memory[:third]), statistics.median(stop_test.memory[-third:])
    print(
        f"memory     {first:.1f} MB in the first third, {last:.1f} MB in the last, most {max(stop_test.memory):.1f} MB"
    )
    print(f"underruns  {stop_test.underruns}; faults seen at a stop: {stop_test.faults}")
    print(f"engine     longest turn of its loop {stop_test.stall_ms:.0f} ms")
    print(
        f"asleep     a process that only sleeps woke late {format_percentiles(stop_test.late)}, most {1e3 * max(stop_test.late):.0f} ms"
    )
    print(f"computer   load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores, these callers among it")
    failures = []
    if stop_test.underruns:
        failures.append(f"{stop_test.underruns} underruns")
    if last - first > GROWTH_MAX_MB:
        failures.append(f"memory grew by {last - first:.0f} MB")
    if any(int(status) >= 500 for status in stop_test.answers):
        failures.append("answers of status 500 and above")
    return failures


def main():
    parser = argparse.ArgumentParser(prog="scripts/load", description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--clients", type=int, default=50, help="who push")
    parser.add_argument("--watchers", type=int, default=20, help="who watch")
    parser.add_argument("--push-s", type=float, default=1.0, help="each pushes so often")
    parser.add_argument("--watch-s", type=float, default=0.1, help="each watches so often")
    parser.add_argument("--pixels", type=int, default=20, help="of each frame")
    parser.add_argument("--config", default="display-437")
    parser.add_argument("--crowd", metavar="URL", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.crowd:
        asyncio.run(ClientPool(options).run())
        return 0
    with tempfile.TemporaryDirectory() as folder:
        rig = LoadRig(Path(folder), options.config)
        try:
            stop_test = StopTest(rig, options)
            try:
                stop_test.run()
            finally:
                stop_test.close()
            failures = print_report(stop_test, 60 * options.minutes)
        finally:
            rig.close()
    p99_s = compute_percentile_ms(stop_test.stop_s, 0.99) * 1e-3
    if p99_s >= STOP_P99_MAX_S:
        print(f"slow       STOP answered p99 {1e3 * p99_s:.0f} ms, wished below {1e3 * STOP_P99_MAX_S:.0f} ms")
    if failures:
        print(f"scripts/load: {'; '.join(failures)}", file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
