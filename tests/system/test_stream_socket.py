"""WebSocket of the daemon: frames, their results and access control."""

import json
import os
import signal
import struct
from contextlib import suppress
from socket import create_connection

import numpy as np
import pytest
from websockets.sync.client import connect

from optodrive.daemon.responses.messages import FrameResult
from rig import TOKEN, wait_for

PIXELS = 437


@pytest.fixture
def daemon(kept):
    _, daemon = kept
    if daemon.board_state() == "DISARMED":
        daemon.arm()
    return daemon


def socket(daemon, token=TOKEN, host="127.0.0.1", **headers):
    headers = {"Authorization": f"Bearer {token}", **headers}
    link = create_connection(("127.0.0.1", daemon.client.base_url.port))
    return connect(f"ws://{host}/v1/stream", sock=link, additional_headers=headers, proxy=None, max_size=None)


def binary(number, pixels, height_um=80.0):
    heights = np.zeros(PIXELS, dtype="<u2")
    heights[list(pixels)] = round(height_um * 10)
    return struct.pack("<4sI", b"ODF1", number) + heights.tobytes()


def until(stream, expected):
    """Return the results up to the first that contains `expected`."""
    answers = []
    while True:
        text = stream.recv()
        FrameResult.model_validate_json(text)
        answers.append(json.loads(text))
        if expected.items() <= answers[-1].items():
            return answers


def test_a_frame_is_planned_then_done_with_its_latency(daemon):
    with socket(daemon) as stream:
        stream.send('{"frame": 3, "target_um": {"17": 120, "18": 90}}')
        planned, done = until(stream, {"frame": 3, "status": "done"})
        assert planned["status"] == "planned"
        assert planned["pulses"] == done["executed"] == 2
        assert done["simulated_max_um"] == pytest.approx(120, rel=0.01)
        latency = done["latency"]
        assert 0 < latency["planned_s"] < latency["first_byte_s"] < latency["first_light_s"]


def test_frames_faster_than_their_emission_are_superseded(daemon):
    with socket(daemon) as stream:
        for number in range(60):
            stream.send(binary(number, range(400)))  # takes 2.5 s
        stream.send(binary(60, range(5)))
        answers = until(stream, {"frame": 60, "status": "done"})
        ends = {}
        for answer in answers:
            if answer["status"] != "planned":
                assert answer["frame"] not in ends
                ends[answer["frame"]] = answer
        assert sorted(ends) == list(range(61))
        assert all(ends[number]["status"] == "superseded" for number in range(60))
        unplanned = [answer for answer in ends.values() if answer.get("superseded_by")]
        assert unplanned
        for answer in ends.values():
            if answer.get("plan") is not None:
                assert answer["planned"] == answer["executed"] + answer["dropped"]


def test_a_wrong_frame_is_refused_and_the_stream_continues(daemon):
    with socket(daemon) as stream:
        stream.send('{"target_um": {"9999": 1}}')
        (refused,) = until(stream, {"status": "refused"})
        assert refused["problem"]["code"] == "unknown_pixel"
        stream.send('{"frame": 1, "target_um": {"17": 900}}')
        (refused,) = until(stream, {"status": "refused"})
        assert refused["problem"]["code"] == "target_unreachable"
        stream.send(binary(2, [3]))
        until(stream, {"frame": 2, "status": "done"})


def test_a_disconnect_ends_the_emission(daemon):
    before = daemon.state()["totals"]["executed"]
    with socket(daemon) as stream:
        stream.send(binary(0, range(400), 300.0))  # many seconds of emission
        (planned,) = until(stream, {"frame": 0, "status": "planned"})
        wait_for(lambda: daemon.state()["totals"]["executed"] > before, "the first light")
    ended = daemon.finished(planned["plan"])
    assert ended["status"] == "superseded"
    assert ended["executed"] < ended["planned"]
    wait_for(lambda: daemon.board_state() == "ARMED", "the board to rest")


def test_sigterm_turns_the_gate_off_at_once_despite_a_connected_client(make_board, make_daemon):
    board = make_board()
    daemon = make_daemon(board)
    daemon.arm()
    with socket(daemon) as stream:
        stream.send(binary(0, range(400), 100.0))
        wait_for(lambda: len(board.of("pulse")) > 20, "pulses")
        web = daemon.find_process("web")
        os.kill(
            web, signal.SIGSTOP
        )  # the end of the connection, for which a server waits for seconds, cannot come first
        daemon.process.terminate()
        wait_for(lambda: board.of("state")[-1]["state"] == "DISARMED", "DISARMED")
        assert board.of("state")[-1]["reason"] == "abort"
        assert board.of("gate")[-1]["on"] is False
        with suppress(ProcessLookupError):  # the daemon may have given up on it
            os.kill(web, signal.SIGCONT)
        assert daemon.process.wait() == 0
    assert "Traceback" not in daemon.errors.read_text()


def test_the_newest_plan_wins_over_rest(daemon):
    frames = {"frames": [{"show_at_s": 0, "duration_s": 9, "target_um": [100.0] * PIXELS}]}
    first = daemon.call("POST", "/v1/plans", json=frames)
    frames["frames"][0]["target_um"] = {"5": 100}
    second = daemon.call("POST", "/v1/plans", params={"newest": True}, json=frames)
    assert daemon.finished(second["plan"])["status"] == "done"
    assert daemon.call("GET", f"/v1/plans/{first['plan']}")["status"] == "superseded"
