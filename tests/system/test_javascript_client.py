"""The client in JavaScript, by node, with a daemon and its board."""

import json
import shutil
import struct
import subprocess
from pathlib import Path

import pytest

from rig import TOKEN, read_role_tokens, wait_for
from test_osc import find_pixels

CLIENT = Path(__file__).parents[2] / "docs/examples/optodrive.js"
SOURCE = Path(__file__).with_name("javascript_source.mjs")


def play(daemon, scene, token=TOKEN):
    """Run a scene. Return what it prints."""
    node = shutil.which("node")
    assert node, "node is not installed: scripts/test-packages"
    command = [node, "--experimental-websocket", SOURCE, CLIENT.as_uri(), scene, daemon.url, token]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def test_frames_at_90_hz_light_their_pixels_and_the_rate_shown_is_reported(kept):
    board, daemon = kept
    if daemon.board_state() == "DISARMED":
        daemon.arm()
    since = len(board.of("pulse"))
    played = play(daemon, "stream")
    assert find_pixels(board, since) == {17, 200}
    counts, results = played["counts"], played["results"]
    finals = [each for each in results if each["status"] != "planned"]
    assert len({each["frame"] for each in finals}) == len(finals) <= counts["sent"] == played["last"] + 1 == 180
    shown = sum(each["status"] == "done" or each.get("executed", 0) > 0 for each in finals)
    assert counts == {"sent": 180, "shown": shown, "superseded": 180 - shown, "other": 0}
    assert next(each for each in finals if each["frame"] == played["last"])["status"] == "done"
    assert sum(each["shown"] for each in played["rates"]) > 0


def test_a_hold_arms_until_the_stop(kept):
    board, daemon = kept
    daemon.call("POST", "/v1/stop")
    played = play(daemon, "hold")
    assert played["counts"]["shown"] > 0
    assert played["ended"]
    wait_for(lambda: daemon.board_state() == "DISARMED", "the stop")
    assert board.of("gate")[-1]["on"] is False


def test_a_viewer_may_stop_and_nothing_else(kept):
    _, daemon = kept
    daemon.arm()
    played = play(daemon, "refused", read_role_tokens(daemon)["viewer"])
    assert all("refuses this token" in each for each in played["refusals"]), played
    assert len(played["refusals"]) == 2
    wait_for(lambda: daemon.board_state() == "DISARMED", "the stop")


@pytest.fixture(scope="module")
def without_daemon():
    class NoDaemon:
        url = "http://127.0.0.1:1"

    return NoDaemon


def test_wrong_heights_are_refused_before_they_are_sent(without_daemon):
    played = play(without_daemon, "wrong")
    assert played["refusals"] == [
        "heights[17]: got -1, expected a height in µm, 0 to 6553.5",
        "heights: got x, expected the number of a pixel",
        "heights[1]: got NaN, expected a height in µm, 0 to 6553.5",
        "heights[17]: got 100000, expected a height in µm, 0 to 6553.5",
        "heights[1]: got 2, expected a height in µm, 0 to 6553.5",
    ]
    assert bytes(played["frame"]) == struct.pack("<4sI3H", b"ODF1", 258, 0, 500, 12345)
