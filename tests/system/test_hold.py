"""Arming that lasts as long as a client: a client that is killed, stopped or gone leaves the board dark."""

import asyncio
import base64
import json
import os
import signal
import subprocess
import time

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from board_fixtures import board_disarmed, daemon_disarmed  # noqa: F401 - fixtures
from optodrive.client import AsyncDisplay, Display
from optodrive.core.errors import NotReadyError
from optodrive.link.service.control import HOLD_MAX_S
from rig import OPTODRIVE, TOKEN, long_train, read_role_tokens, wait_for

AT_ONCE_S = 0.5
LATE_S = 0.5
"""Time for the processes of a busy computer."""


@pytest.fixture
def running(daemon):
    return daemon


def start_push(daemon, folder, *options, seconds=20.0):
    """Start `optodrive push --hold` and return its process."""
    frames = folder / "frames.json"
    frames.write_text(json.dumps(long_train(seconds=seconds)))
    return subprocess.Popen(
        [OPTODRIVE, "push", frames, "--hold", "--url", daemon.url, *options],
        env={**os.environ, "OPTODRIVE_TOKEN": TOKEN},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_light(board):
    wait_for(lambda: any(event["on"] for event in board.of("gate")), "light")


def wait_for_dark(board):
    """Return the time until the board is disarmed with the gate off, by its log."""
    began_s = time.monotonic()
    wait_for(lambda: board.of("state")[-1]["state"] == "DISARMED", "DISARMED")
    dark_s = time.monotonic() - began_s
    assert not any(event["on"] for event in board.of("gate")[-1:])
    return dark_s


@pytest.mark.parametrize(("number", "max_s"), [(signal.SIGKILL, AT_ONCE_S), (signal.SIGSTOP, HOLD_MAX_S + LATE_S)])
def test_a_client_that_is_killed_or_stopped_leaves_the_board_dark(running, board, tmp_path, number, max_s):
    client = start_push(running, tmp_path)
    try:
        wait_for_light(board)
        assert running.state()["control"]["hold"]
        client.send_signal(number)
        assert wait_for_dark(board) < max_s
    finally:
        client.kill()
        client.communicate()
    plan = running.finished(running.state()["queue"]["plans"][-1]["plan"])
    assert plan["status"] == "failed"
    assert "that held the board armed" in plan["error"]
    assert running.state()["control"] is None


def test_a_client_that_does_not_hold_leaves_its_plan_running(running, board, tmp_path):
    """The counterpart: what is to be prevented happens without --hold."""
    running.arm()
    client = start_push(running, tmp_path)
    client.communicate()  # it is refused, for the board is armed already
    assert client.returncode == 1
    running.call("POST", "/v1/plans", json=long_train(seconds=20.0))
    wait_for_light(board)
    time.sleep(HOLD_MAX_S + LATE_S)
    assert running.board_state() == "RUNNING"


def test_a_command_that_ends_disarms(running, board, tmp_path):
    client = start_push(running, tmp_path, seconds=0.2)
    output, errors = client.communicate(timeout=30)
    assert client.returncode == 0, errors
    assert "done" in output
    wait_for_dark(board)
    refused = start_push(running, tmp_path, "--dry-run")
    assert "--hold: got '--dry-run'" in refused.communicate(timeout=30)[1]


def test_a_display_holds_until_it_is_closed_or_stopped(running, board):
    display = Display(running.url, TOKEN)
    assert display.arm(hold=True).control.hold
    other = Display(running.url, TOKEN)
    with pytest.raises(NotReadyError, match="only a DISARMED board"):
        other.arm(hold=True)
    other.close()
    time.sleep(HOLD_MAX_S + LATE_S)
    assert display.state().board.state == "ARMED"
    display.close()
    assert wait_for_dark(board) < AT_ONCE_S

    async def hold():
        async with AsyncDisplay(running.url, TOKEN) as display:
            assert (await display.arm(hold=True)).control.hold
            await asyncio.sleep(HOLD_MAX_S + LATE_S)
            assert (await display.state()).board.state == "ARMED"
            running.call("POST", "/v1/stop")
            await asyncio.sleep(0.2)
            return display._hold.reason

    assert asyncio.run(hold()) == "ended by stop"


def open_as_browser(daemon, secret):
    """Open the WebSocket as a page can: with the token among the subprotocols."""
    encoded = base64.urlsafe_b64encode(secret.encode()).decode().rstrip("=")
    origin = daemon.url
    url = f"ws{daemon.url.removeprefix('http')}/v1/hold"
    return connect(url, origin=origin, subprotocols=["optodrive", f"bearer.{encoded}"], compression=None)


def test_a_page_holds_with_the_token_among_the_subprotocols(running, board):
    with pytest.raises(InvalidStatus) as refused:
        open_as_browser(running, "not-a-token-of-anybody")
    assert refused.value.response.status_code == 401
    with pytest.raises(InvalidStatus) as refused:
        open_as_browser(running, read_role_tokens(running)["operator"])
    assert refused.value.response.status_code == 403
    with open_as_browser(running, TOKEN) as page:
        assert page.subprotocol == "optodrive"
        for _ in range(30):
            page.send("beat")
            try:
                assert json.loads(page.recv(timeout=0.25)) == {"status": "armed"}
                break
            except TimeoutError:
                pass
        assert running.board_state() == "ARMED"
        running.call("POST", "/v1/disarm")
        assert json.loads(page.recv(timeout=5)) == {"status": "ended", "reason": "ended by disarm"}
