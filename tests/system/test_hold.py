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
from forked_process import start_process
from optodrive.client import AsyncDisplay, Display
from optodrive.core.errors import NotReadyError
from optodrive.daemon.api.client_sockets import CLIENT_LEFT
from optodrive.link.service.control import HOLD_MAX_S
from rig import OPTODRIVE, TOKEN, long_train, read_role_tokens, wait_for

UNHELD_S = 1.5 * HOLD_MAX_S
"""Time after which an arming that nobody holds has ended."""
NO_BEAT = "the client of 'armer' that held the board armed does not beat"


@pytest.fixture
def running(daemon):
    return daemon


def start_push(daemon, folder, *options, seconds=20.0):
    """Start `optodrive push --hold` and return its process."""
    frames = folder / "frames.json"
    frames.write_text(json.dumps(long_train(seconds=seconds)))
    return start_process(
        [OPTODRIVE, "push", frames, "--hold", "--url", daemon.url, *options],
        env={**os.environ, "OPTODRIVE_TOKEN": TOKEN},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_light(board):
    wait_for(lambda: any(event["on"] for event in board.of("gate")), "light")


def wait_for_dark(board):
    """Wait until the board is disarmed with the gate off, by its log."""
    wait_for(lambda: board.of("state")[-1]["state"] == "DISARMED", "DISARMED")
    assert not any(event["on"] for event in board.of("gate")[-1:])


@pytest.mark.parametrize(
    ("number", "reasons"), [(signal.SIGKILL, (CLIENT_LEFT, NO_BEAT)), (signal.SIGSTOP, (NO_BEAT,))]
)
def test_a_client_that_is_killed_or_stopped_leaves_the_board_dark(running, board, tmp_path, number, reasons):
    """On a slow computer the missing beats of a killed client may be noticed before its end is."""
    client = start_push(running, tmp_path, seconds=60.0)
    try:
        wait_for_light(board)
        assert running.state()["control"]["hold"]
        client.send_signal(number)
        wait_for_dark(board)
    finally:
        client.kill()
        client.communicate()
    plan = running.finished(running.state()["queue"]["plans"][-1]["plan"])
    assert plan["status"] == "failed"
    assert plan["error"] in reasons
    assert running.state()["control"] is None


def test_a_client_that_does_not_hold_leaves_its_plan_running(running, board, tmp_path):
    """The counterpart: without --hold the plan runs on, which --hold prevents."""
    running.arm()
    client = start_push(running, tmp_path)
    client.communicate()  # it is refused, for the board is armed already
    assert client.returncode == 1
    running.call("POST", "/v1/plans", json=long_train(seconds=2 * UNHELD_S))
    wait_for_light(board)
    begun_us = board.of("gate")[0]["t_us"]
    wait_for(lambda: board.of("gate")[-1]["t_us"] > begun_us + UNHELD_S * 1e6, "light without a holder")


def test_a_command_that_ends_disarms(running, board, tmp_path):
    client = start_push(running, tmp_path, seconds=0.2)
    output, errors = client.communicate()
    assert client.returncode == 0, errors
    assert "done" in output
    wait_for_dark(board)
    refused = start_push(running, tmp_path, "--dry-run")
    assert "--hold: got '--dry-run'" in refused.communicate()[1]


def test_a_display_holds_until_it_is_closed_or_stopped(running, board):
    display = Display(running.url, TOKEN)
    assert display.arm(hold=True).control.hold
    other = Display(running.url, TOKEN)
    with pytest.raises(NotReadyError, match="only a DISARMED board"):
        other.arm(hold=True)
    other.close()
    time.sleep(UNHELD_S)
    assert display.state().board.state == "ARMED"
    display.close()
    wait_for_dark(board)

    async def hold():
        async with AsyncDisplay(running.url, TOKEN) as display:
            assert (await display.arm(hold=True)).control.hold
            await asyncio.sleep(UNHELD_S)
            assert (await display.state()).board.state == "ARMED"
            running.call("POST", "/v1/stop")
            while not display._hold.reason:
                await asyncio.sleep(0.01)
            return display._hold.reason

    assert asyncio.run(hold()) == "ended by stop"


def open_as_browser(daemon, secret):
    """Open the WebSocket as a page can: with the token among the subprotocols."""
    encoded = base64.urlsafe_b64encode(secret.encode()).decode().rstrip("=")
    origin = daemon.url
    url = f"ws{daemon.url.removeprefix('http')}/v1/hold"
    return connect(url, origin=origin, subprotocols=["optodrive", f"bearer.{encoded}"], compression=None)


def wait_until_held(page):
    """Send beats until the board is armed."""
    while True:
        page.send("beat")
        try:
            assert json.loads(page.recv(timeout=0.25)) == {"status": "armed"}
            return
        except TimeoutError:
            pass


def test_a_page_holds_with_the_token_among_the_subprotocols(running, board):
    with pytest.raises(InvalidStatus) as refused:
        open_as_browser(running, "not-a-token-of-anybody")
    assert refused.value.response.status_code == 401
    with pytest.raises(InvalidStatus) as refused:
        open_as_browser(running, read_role_tokens(running)["operator"])
    assert refused.value.response.status_code == 403
    with open_as_browser(running, TOKEN) as page:
        assert page.subprotocol == "optodrive"
        wait_until_held(page)
        assert running.board_state() == "ARMED"
        running.call("POST", "/v1/disarm")
        assert json.loads(page.recv()) == {"status": "ended", "reason": "ended by disarm"}


@pytest.mark.parametrize("said", ['{"hold": false}', "Beat", b"beat"])
def test_a_message_that_is_no_beat_ends_the_hold(running, board, said):
    with open_as_browser(running, TOKEN) as page:
        wait_until_held(page)
        page.send(said)
        assert json.loads(page.recv()) == {"status": "ended", "reason": f"message: got {said!r}, expected 'beat'"}
    wait_for_dark(board)
