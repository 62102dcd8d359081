"""PUT /v1/dim over REST: who may lower and raise the power, and that no restart of a process brightens it."""

import os
import signal

import pytest

from board_fixtures import board_disarmed, daemon_disarmed  # noqa: F401 - fixtures
from optodrive.client import Display
from rig import TOKEN, read_role_tokens, wait_for

FULL_DUTY = 65535
FRAME = {"frames": [{"show_at_s": 0.0, "duration_s": 1.0, "target_um": {"200": 120, "201": 120}}]}


def dim(daemon, share, role="armer", status=None):
    headers = {"Authorization": f"Bearer {read_role_tokens(daemon)[role]}"}
    return daemon.call("PUT", "/v1/dim", status, json={"share": share}, headers=headers)


@pytest.fixture
def bright(daemon):
    yield daemon
    dim(daemon, 1.0)


def find_max_share(board):
    return max(event["duty"] for event in board.of("pulse")) / FULL_DUTY


def kill_planner(daemon):
    """Kill the planner process and wait until another one serves."""
    first = daemon.find_process("planner")
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: daemon.find_process("planner") not in (None, first), "the next planner")
    wait_for(lambda: daemon.client.get("/metrics").is_success, "its answer, which follows its state")
    return daemon.state()["limits"]["power_share"]


def test_an_operator_lowers_the_power_an_armer_raises_it_and_a_restart_keeps_it(bright, board):
    assert bright.state()["limits"]["power_share"] == 1.0
    dim(bright, 0.2, "viewer", 403)
    assert dim(bright, 0.2, "operator")["limits"]["power_share"] == 0.2
    problem = dim(bright, 0.3, "operator", 403)
    assert (problem["code"], problem["required_role"]) == ("insufficient_role", "armer")
    assert "raise the power above 0.2" in problem["detail"]
    assert kill_planner(bright) == 0.2

    bright.arm()
    plan = bright.call("POST", "/v1/plans", json=FRAME)
    assert set(plan["pulses"]["reason"]) == {"dim"}
    assert bright.finished(plan["plan"])["executed"] == 2
    assert 0.19 < find_max_share(board) <= 0.2
    problem = bright.call("POST", "/v1/plans", 409, params={"policy": "refuse"}, json=FRAME)
    assert (problem["code"], problem["cap"]) == ("over_budget", "dim")
    dry_run = bright.call("POST", "/v1/plans", params={"dry_run": True}, json=FRAME)
    assert set(dry_run["pulses"]["reason"]) == {"dim"}

    board.forget()
    with Display(bright.url, TOKEN) as display:
        assert display.dim(1.0).limits.power_share == 1.0
        assert set(display.push(FRAME).pulses.reason) == {""}
    assert find_max_share(board) > 0.2
