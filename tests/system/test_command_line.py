"""Commands to a running daemon as a shell runs them, with the address in the environment."""

import json
import os
import re
import signal
import subprocess
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread

import pytest

from forked_process import run_process, start_process
from optodrive.cli import control
from optodrive.client import Display
from optodrive.core.errors import LinkError
from rig import OPTODRIVE, TOKEN, long_train, running, wait_for


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    with running(tmp_path_factory.mktemp("commands")) as (board, daemon):
        yield board, daemon


@pytest.fixture(autouse=True)
def disarmed(rig):
    yield
    rig[1].call("POST", "/v1/stop")
    rig[0].forget()


def command(daemon, *arguments):
    return run_process(
        [OPTODRIVE, *arguments],
        env=os.environ | {"OPTODRIVE_URL": daemon.url, "OPTODRIVE_TOKEN": TOKEN},
        capture_output=True,
        text=True,
    )


def test_status_shows_limits_and_the_counters_of_the_link(rig):
    _, daemon = rig
    ended = command(daemon, "status")
    assert ended.returncode == 0, ended.stderr
    lines = dict(line.split(maxsplit=1) for line in ended.stdout.splitlines())
    assert lines["board"] == "DISARMED"
    assert re.match(r"\d+ frames retransmitted, \d+ refused, \d+ damaged on arrival here, ", lines["counters"])
    assert "absorber temperature 400 °C" in lines["limits"]
    assert "energy of a pulse 125 mJ" in lines["limits"]


LIST_MODULES = """
import sys
from optodrive.cli.main import run

status = run(sys.argv[1:])
names = "optodrive.client.requests", "optodrive.core.json_model", "numpy", "asyncio", "websockets"
print(*(name for name in names if name in sys.modules), file=sys.stderr)
sys.exit(status)
"""


@pytest.mark.parametrize("arguments", [("status",), ("arm",), ("status", "--json"), ("disarm",)])
def test_control_imports_no_models(rig, arguments):
    """They would take longer than everything else that the command does."""
    _, daemon = rig
    ended = subprocess.run(
        [sys.executable, "-c", LIST_MODULES, *arguments],
        env=os.environ | {"OPTODRIVE_URL": daemon.url, "OPTODRIVE_TOKEN": TOKEN},
        capture_output=True,
        text=True,
    )
    assert (ended.returncode, ended.stderr) == (0, "\n")


def test_a_daemon_of_another_version_is_named(capsys):
    with pytest.raises(LinkError, match="no 'board': is the daemon of another version"):
        control._print_state({"pixels": 3}, as_json=False)


def test_arming_an_armed_board_does_nothing(rig):
    board, daemon = rig
    assert command(daemon, "arm").returncode == 0
    with Display(daemon.url, TOKEN) as display:
        assert display.arm().board.state == "ARMED"
        plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=0.1))["plan"]
        assert daemon.finished(plan)["status"] == "done"
    assert [entry["reason"] for entry in board.of("state")].count("armed") == 1


def test_an_experiment_is_shown_as_requested_or_not_at_all(rig):
    _, daemon = rig
    daemon.arm()
    replies = [daemon.client.post("/v1/patterns/experiment-4", json={"level": 9}) for _ in range(3)]
    assert [reply.status_code for reply in replies] == [201, 201, 409]
    assert replies[2].json()["code"] == "over_budget"
    trimmed = daemon.call("POST", "/v1/patterns/experiment-4?policy=trim", json={"level": 9})
    assert trimmed["summary"]["trimmed"]["pulses"] > 0
    daemon.call("POST", "/v1/stop")
    daemon.arm()
    dry_run = "/v1/patterns/experiment-4?dry_run=true"
    wait_for(lambda: daemon.client.post(dry_run, json={"level": 9}).is_success, "the pixels to cool")
    ended = command(daemon, "play", "experiment-4", "level=9")
    assert (ended.returncode, ended.stderr) == (0, "")


def start_push(url, tmp_path, *options):
    (tmp_path / "train.json").write_text(json.dumps(long_train(seconds=300.0)))
    return start_process(
        [OPTODRIVE, "push", str(tmp_path / "train.json"), *options],
        env=os.environ | {"OPTODRIVE_URL": url, "OPTODRIVE_TOKEN": TOKEN},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_ends_a_push_ends_its_light(rig, tmp_path, number):
    board, daemon = rig
    daemon.arm()
    with start_push(daemon.url, tmp_path) as process:
        wait_for(lambda: daemon.state()["queue"]["running"] is not None, "light")
        process.send_signal(number)
        errors = process.stderr.read()
    assert process.returncode == 130
    wait_for(lambda: daemon.state()["queue"]["running"] is None, "the end of the plan, which a stop reports later")
    (plan,) = daemon.state()["queue"]["plans"][-1:]
    assert plan["status"] in ("cancelled", "stopped"), errors
    assert daemon.board_state() == ("ARMED" if plan["status"] == "cancelled" else "DISARMED")
    wait_for(lambda: not board.all_of("gate")[-1]["on"], "the end of light")


def test_a_push_that_does_not_wait_leaves_its_plan_playing(rig, tmp_path):
    _, daemon = rig
    daemon.arm()
    with start_push(daemon.url, tmp_path, "--no-wait") as process:
        assert process.wait() == 0
    wait_for(lambda: daemon.state()["queue"]["running"] is not None, "light")


class ScriptedDaemon(BaseHTTPRequestHandler):
    """Answers what the test gives it by method and path, and leaves other requests without an answer."""

    def answer(self):
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        call = f"{self.command} {self.path.partition('?')[0]}"
        self.server.calls.append(call)
        if call not in self.server.answers:
            self.server.end.wait()
            return
        body = json.dumps(self.server.answers[call]).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    do_GET = do_POST = do_DELETE = answer  # noqa: N815 - names of http.server

    def log_message(self, *arguments):
        pass


@pytest.mark.parametrize(
    ("unanswered", "awaited", "last", "says"),
    [
        ((), "GET /v1/plans/p7", "DELETE /v1/plans/p7", "plan p7: cancelled, 3 pulses executed"),
        (("POST /v1/plans",), "POST /v1/plans", "POST /v1/stop", "the display was stopped, because"),
    ],
)
def test_a_push_ends_its_plan_alone_if_it_knows_it(rig, tmp_path, unanswered, awaited, last, says):
    """Before the answer nobody knows whether the daemon plays it."""
    plan = rig[1].call("POST", "/v1/plans?dry_run=true", json=long_train(seconds=0.1)) | {
        "plan": "p7",
        "status": "running",
    }
    answers = {
        "GET /v1/health": rig[1].call("GET", "/v1/health"),
        "POST /v1/plans": plan,
        "GET /v1/plans/p7": plan,
        "DELETE /v1/plans/p7": plan | {"status": "cancelled", "executed": 3},
        "POST /v1/stop": rig[1].call("GET", "/v1/state"),
    }
    with ThreadingHTTPServer(("127.0.0.1", 0), ScriptedDaemon) as server:
        server.calls, server.end = [], Event()
        server.answers = {call: answer for call, answer in answers.items() if call not in unanswered}
        Thread(target=server.serve_forever, daemon=True).start()
        with start_push(f"http://127.0.0.1:{server.server_port}", tmp_path) as process:
            wait_for(lambda: awaited in server.calls, "the awaited request")
            process.send_signal(signal.SIGTERM)
            errors = process.stderr.read()
        server.end.set()
        server.shutdown()
    assert process.returncode == 130
    assert server.calls[-1] == last
    assert errors.startswith(f"optodrive: {says}")
    assert errors.endswith("\noptodrive: interrupted\n")
