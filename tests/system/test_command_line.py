"""Commands to a running daemon as a shell runs them, with the address in the environment."""

import os
import re
import subprocess
import sys

import pytest

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
    return subprocess.run(
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
