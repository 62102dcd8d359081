"""Board process on a pseudo-terminal and daemon on it, for the system tests."""

import json
import os
import re
import resource
import signal
import subprocess
import time
import tomllib
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import httpx

from forked_process import OPTODRIVE, SHORT_INDICATOR, start_process
from optodrive.device.config_file import locate_shipped

TOKEN = "a-token-for-tests"
NAP_MAX_S = 0.02
PATIENT_LEASE_S, PATIENT_LEAD_S = 1.0, 0.2
"""Maximum lease, and the maximum lead of streams, for tests that are about neither.

A busy machine may stall a host for 0.1 s, and the bytes on a pseudo-terminal for some 10 ms."""
ENDED = ("done", "superseded", "stopped", "failed", "cancelled")


def wait_for(condition, what, nap_s=0.005):
    """Poll until condition() is truthy and return its value. Poll less often the longer it takes.

    Only pytest's timeout ends it, which shows `what`: how long something takes is the computer's affair.
    """
    since = time.monotonic()
    while not (value := condition()):
        time.sleep(min(max(nap_s, (time.monotonic() - since) / 50), NAP_MAX_S))
    return value


def ended(engine, plan):
    """Wait until a plan of an engine in this process has ended and return its report."""
    plan_id = plan if isinstance(plan, str) else plan.plan

    def look():
        report = engine.get_plan(plan_id)
        return report if report.status in ENDED else None

    return wait_for(look, "the plan's end")


class Board:
    """Board process with its log. program: command line, by default the simulated board with a short indicator."""

    def __init__(self, folder, script="", limits="", disk_bytes=None, program=SHORT_INDICATOR, seed=None, sensor=None):
        self.port = folder / "tty"
        self.log = folder / "board.jsonl"
        arguments = ["--pty", self.port, "--log", self.log]
        arguments += [] if seed is None else ["--seed", str(seed)]
        self.sensor = None
        if sensor is not None:  # options of a simulated spot sensor
            self.sensor = folder / "sensor"
            arguments += ["--sensor", self.sensor, *sensor]
        limits = limits or f"lease_ms = {PATIENT_LEASE_S * 1e3:.0f}\n"  # a host may request a shorter lease
        for option, text in (("--script", script), ("--limits", limits)):
            if text:
                path = folder / f"board{option}.toml"
                path.write_text(text)
                arguments += [option, path]
        options = {}
        if disk_bytes:
            limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (disk_bytes, disk_bytes))
            options = {"stderr": subprocess.PIPE, "preexec_fn": limit}
        self.process = start_process([*program, *arguments], text=True, **options)
        self._events, self._read_bytes, self._forgotten = [], 0, 0
        wait_for(self.port.exists, "the board's port")

    def events(self):
        if self.log.exists():  # only what is new is read: tests poll
            with self.log.open("rb") as file:
                file.seek(self._read_bytes)
                text = file.read()
            text = text[: text.rfind(b"\n") + 1]
            self._read_bytes += len(text)
            self._events += [json.loads(line) for line in text.splitlines()]
        return self._events[self._forgotten :]

    def now_us(self):
        """Return the present time on the clock of the log, which the log itself reaches only with its next event."""
        path = Path(f"{self.port}.clock")
        text = wait_for(lambda: path.exists() and path.read_text().strip(), "the board's clock")
        return (time.monotonic() - float(text)) * 1e6

    def forget(self):
        """Ignore the events logged so far."""
        self._forgotten += len(self.events())

    def all_of(self, kind):
        """Return all events of a kind, the forgotten ones too."""
        self.events()
        return [event for event in self._events if event["event"] == kind]

    def of(self, kind):
        return [event for event in self.events() if event["event"] == kind]

    def kill(self):
        """Kill the process. Its port's name goes first: the kernel soon gives its terminal to another board."""
        self.port.unlink(missing_ok=True)
        self.process.kill()
        self.process.wait()

    def stop(self):
        self.process.terminate()
        self.process.wait()
        if self.process.stderr:
            self.process.stderr.close()


def config_text(port=None, name="display-437", sensor=None, lease_s=PATIENT_LEASE_S):
    """Return the text of a shipped configuration with the ports of a board, by default simulated, and a sensor."""
    text = locate_shipped(f"{name}.toml").read_text()
    lead = f"stream_lead_s = {PATIENT_LEAD_S}\n" if lease_s == PATIENT_LEASE_S else ""
    text, count = re.subn(r"(?m)^lease_s = \S+", f"{lead}lease_s = {lease_s}", text)
    assert count == 1
    if port is not None:
        text = re.sub(r'transport = "simulated".*', f'transport = "serial"\nport = "{port}"', text)
    return text if sensor is None else f'{text}\n[sensor]\nport = "{sensor}"\n'


class Command:
    """Process of an `optodrive` command with the ports of a board and its sensor. field: calibrated field, if any."""

    def __init__(self, folder, board, *arguments, lease_s=PATIENT_LEASE_S, field=None):
        config = folder / "bench.toml"
        text = config_text(board.port, sensor=board.sensor, lease_s=lease_s)
        config.write_text(text if field is None else text.replace("[scanner]", f'[scanner]\nfield = "{field}"'))
        self.process = start_process(
            [OPTODRIVE, *map(str, arguments), "--config", config],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def ended(self):
        """Wait for the end and return status, stdout and stderr."""
        out, errors = self.process.communicate()
        assert "Traceback" not in errors, errors
        return self.process.returncode, out, errors

    def stop(self):
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()


class Daemon:
    """Process of `optodrive serve` on a board's port. is_fresh: in an interpreter of its own, as a user starts it.

    stages: text of further sections
    """

    def __init__(
        self,
        folder,
        port,
        name="display-437",
        replace=(),
        options=(),
        lease_s=PATIENT_LEASE_S,
        runtime=None,
        is_fresh=False,
        stages="",
    ):
        text = config_text(port, name, lease_s=lease_s) + stages
        for old, new in replace:
            assert old in text
            text = text.replace(old, new)
        self.config = folder / "config.toml"
        self.config.write_text(text)
        self.errors = folder / "daemon.err"
        environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "XDG_RUNTIME_DIR": str(runtime or folder)}
        with self.errors.open("a") as errors:
            self.process = (subprocess.Popen if is_fresh else start_process)(
                [
                    OPTODRIVE,
                    "serve",
                    "--config",
                    self.config,
                    *(options if "--port" in options else ("--port", "0", *options)),
                ],
                stdout=subprocess.PIPE,
                stderr=errors,
                env=environment,
                text=True,
            )
        self.client = httpx.Client(headers={"Authorization": f"Bearer {TOKEN}"}, timeout=None)
        try:
            self.announcement = self.process.stdout.readline()
            found = re.search(r"(http://[\d.]+:\d+)", self.announcement)
            assert found, self.announcement + self.errors.read_text()
            self.url = found.group(1)
            self.client.base_url = self.url
            self.call("GET", "/v1/state")
        except BaseException:
            self.stop()
            raise

    def call(self, method, path, status=None, **request):
        response = self.client.request(method, path, **request)
        if status is None:
            assert response.is_success, response.text
        else:
            assert response.status_code == status, response.text
        return response.json()

    def arm(self):
        return self.call("POST", "/v1/arm")

    def state(self):
        return self.call("GET", "/v1/state")

    def board_state(self):
        return self.state()["board"]["state"]

    def list_children(self):
        """Return the process ids of the daemon's processes besides the supervisor."""
        pid = self.process.pid
        return [int(text) for text in read_proc(pid, f"task/{pid}/children").split()]

    def find_process(self, name):
        """Return the process id of a process by its name in the state, None while there is none."""
        if name == "supervisor":
            return self.process.pid
        for child in self.list_children():
            is_link = "link.service" in read_proc(child, "cmdline")
            if is_link if name == "link" else read_proc(child, "comm") == f"opto-{name}\n":
                return child
        return None

    def finished(self, plan):
        def ended():
            answer = self.call("GET", f"/v1/plans/{plan}")
            return answer if answer["status"] in ENDED else None

        return wait_for(ended, f"plan {plan} to end", nap_s=0.02)

    def stop(self):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
        self.process.wait()
        self.process.stdout.close()
        self.client.close()


def read_proc(pid, name):
    """Return the text of a file of a process in /proc, empty if the process has ended."""
    try:
        return Path(f"/proc/{pid}/{name}").read_text()
    except OSError:
        return ""


def is_suspended(pid):
    """Return whether a process was stopped by a signal, and was neither continued nor killed since."""
    return read_proc(pid, "stat").rpartition(")")[2].split()[:1] == ["T"]


def is_alive(pid):
    """Return whether a process runs, is suspended or waits. A zombie does not."""
    return read_proc(pid, "stat").rpartition(")")[2].split()[:1] not in ([], ["Z"])


def read_role_tokens(daemon):
    """Return the secret of each role that the daemon wrote at its start."""
    path = next((daemon.config.parent / "optodrive").glob("token-*"))
    entries = tomllib.loads(path.read_text())["token"]
    return {entry["role"]: entry["secret"] for entry in entries}


@contextmanager
def running(folder, replace=(), name="display-437", lease_s=PATIENT_LEASE_S, **options):
    """Run a board and a daemon on it.

    replace: changes of the configuration
    options: of the board
    """
    board = Board(folder, **options)
    try:
        daemon = Daemon(folder, board.port, name, replace, lease_s=lease_s)
        try:
            yield board, daemon
        finally:
            daemon.stop()
    finally:
        board.stop()


def long_train(pixel=200, seconds=5.0):
    """Return a request for a train of pulses: 10 ms on, 10 ms off."""
    train = {
        "pixel": pixel,
        "start_s": 0.0,
        "duration_s": seconds,
        "pulse_width_s": 0.010,
        "gap_s": 0.010,
        "power_w": 1.0,
    }
    return {"trains": [train]}
