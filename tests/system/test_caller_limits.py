"""What one caller's hostile requests may cost the others: a running show, a push, memory, the audit log."""

import fcntl
import json
import os
import socket
import time
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from floods import build_full_frames, build_refused_bodies
from process_memory import list_processes, read_peak_mib
from rig import Board, Daemon, read_role_tokens, wait_for
from stop_rig import FLOOD_LEASE_S, PIXELS, FloodProcess, StopRig
from test_security import build_bearer_header, build_daemon_replacement

PREVIEW_FRAMES = 750
SMALL_PUSH_MAX_S = 1.0
REFUSAL_MAX_S = 5.0
"""24 threads of this test send 24 bodies of 140 kB first; one dry run after the other would take longer."""
GROWTH_MAX_MIB = 100.0
"""Growth of the daemon's peak memory while compressed frames arrive: a dozen of the largest bodies."""


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("limits")
    rig = StopRig(folder, FLOOD_LEASE_S, options=f'audit = "{folder}/audit.jsonl"\nsocket = "{folder}/s"')
    yield rig
    rig.close()


def post(rig, body, path="/v1/plans", role="operator", **params):
    headers = build_bearer_header(read_role_tokens(rig.daemon)[role])
    return httpx.post(rig.daemon.url + path, params=params, content=body, headers=headers, timeout=60)


@pytest.mark.slow  # the flood of valid previews does the same in every run
def test_a_valid_preview_does_not_darken_a_show(rig):
    with rig.running_show() as begin:
        response = post(rig, build_full_frames(PREVIEW_FRAMES, PIXELS), dry_run=True)
        time.sleep(0.5)
        assert rig.find_darkness(begin) == []
        assert rig.find_gap_s(begin) < 0.5
    assert response.status_code == 200, response.text[:300]
    assert response.json()["planned"] > 0
    assert rig.client.get(f"/v1/plans/{response.json()['plan']}").status_code == 404


def test_refused_bodies_of_8_MB_do_not_darken_a_show(rig):
    bodies = build_refused_bodies(PIXELS)
    with rig.running_show() as begin:
        statuses = [post(rig, body).status_code for body in bodies]
        time.sleep(0.5)
        assert rig.find_darkness(begin) == []
        assert rig.find_gap_s(begin) < 0.5
    assert set(statuses) <= {413, 422, 503}


def abandon_dry_run(rig, frames):
    base, body = rig.client.base_url, build_full_frames(frames, PIXELS)
    head = f"POST /v1/plans?dry_run=true HTTP/1.1\r\nHost: {base.host}\r\nContent-Length: {len(body)}\r\n"
    head += f"Authorization: Bearer {read_role_tokens(rig.daemon)['operator']}\r\n\r\n"
    with socket.create_connection((base.host, base.port), timeout=20) as link:
        link.sendall(head.encode() + body)
        time.sleep(0.2)


@pytest.mark.parametrize(("count", "frames"), [(5, 730), pytest.param(1, 5_600, marks=pytest.mark.slow)])
def test_abandoned_dry_runs_do_not_hold_up_another_callers_push(rig, count, frames):
    rig.arm()
    for _ in range(count):
        abandon_dry_run(rig, frames)
    body = b'{"frames":[{"show_at_s":0,"duration_s":1,"target_um":{"17":60}}]}'
    begin_s = time.monotonic()
    response = post(rig, body)
    waited_s = time.monotonic() - begin_s
    rig.client.post("/v1/stop")
    assert response.status_code == 201, response.text
    assert waited_s <= SMALL_PUSH_MAX_S


def test_more_dry_runs_than_may_wait_are_refused_at_once(rig):
    body, begin_s = build_full_frames(100, PIXELS), time.monotonic()
    with ThreadPoolExecutor(24) as pool:

        def run(_):
            response = post(rig, body, dry_run=True)
            return response.status_code, time.monotonic() - begin_s, response.text

        answers = list(pool.map(run, range(24)))
    refused = [answer for answer in answers if answer[0] in (429, 503)]
    assert refused, [answer[0] for answer in answers]
    assert {answer[0] for answer in answers} <= {200, 422, 429, 503}
    assert 200 in {answer[0] for answer in answers}
    assert min(answer[1] for answer in refused) <= REFUSAL_MAX_S
    assert all("\n" not in json.loads(answer[2])["detail"] for answer in refused)


def test_compressed_frames_are_not_expanded_in_memory(rig):
    peaks_mib = {pid: read_peak_mib(pid) for pid in list_processes(rig.daemon.process.pid).values()}
    flood = FloodProcess("compressed frames", rig.daemon.url, read_role_tokens(rig.daemon))
    time.sleep(3.0)
    growth_mib = sum(max(0.0, read_peak_mib(pid) - peak_mib) for pid, peak_mib in peaks_mib.items())
    assert flood.finish()
    assert growth_mib < GROWTH_MAX_MIB


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Authorization": "Bearer " + "wrong" * 8}, 401),
        ({"Host": "evil.example"}, 421),
        ({"Host": "[::1].evil"}, 421),
        ({"Origin": "https://evil.example"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Origin": "https://{host}"}, 403),
    ],
)
def test_a_guess_at_arming_is_refused_and_audited(rig, headers, status):
    folder, base = rig.daemon.config.parent, rig.client.base_url
    headers = {name: value.replace("{host}", f"{base.host}:{base.port}") for name, value in headers.items()}

    def read_lines():
        lines = (folder / "audit.jsonl").read_text().splitlines()
        return [line for line in map(json.loads, lines) if line.get("call") == "POST /v1/arm"]

    before = len(read_lines())
    assert rig.client.post("/v1/arm", headers=headers).status_code == status
    line = wait_for(lambda: (lines := read_lines()[before:]) and lines[-1], "the line of the audit log", 3.0)
    assert (line["event"], line["status"], line["address"]) == ("refused", status, "127.0.0.1")


def test_a_body_that_hangs_up_logs_no_traceback(rig):
    base = rig.client.base_url
    for role in ("operator", "viewer"):
        with socket.create_connection((base.host, base.port)) as link:
            head = f"POST /v1/plans HTTP/1.1\r\nHost: {base.host}\r\nContent-Length: 1000\r\n"
            head += f"Authorization: Bearer {read_role_tokens(rig.daemon)[role]}\r\n\r\n"
            link.sendall(head.encode() + b"{")
            time.sleep(0.1)
    time.sleep(0.5)
    assert "Traceback" not in rig.daemon.errors.read_text()


def test_an_audit_path_that_hangs_delays_neither_STOP_nor_the_end(make_board, tmp_path):
    """A FIFO that nobody reads any more."""
    board, fifo = make_board(), tmp_path / "audit"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    fcntl.fcntl(reader, fcntl.F_SETPIPE_SZ, 4096)
    daemon = Daemon(tmp_path, board.port, replace=build_daemon_replacement(f'audit = "{fifo}"'))
    try:
        for _ in range(60):  # more lines than the pipe holds
            daemon.client.post("/v1/stop")
        begin_s = time.monotonic()
        assert daemon.client.post("/v1/stop").status_code == 200
        assert time.monotonic() - begin_s < 0.5
        begin_s = time.monotonic()
        daemon.process.terminate()
        daemon.process.wait(timeout=40)
        assert time.monotonic() - begin_s < 10.0
    finally:
        os.close(reader)
        daemon.stop()


def test_a_board_that_comes_late_is_waited_for(tmp_path):
    daemon = Daemon(tmp_path, tmp_path / "tty")
    try:
        state = daemon.state()
        assert state["link"]["state"] == "down"
        assert state["link"]["port"] == str(tmp_path / "tty")
        assert "expected a serial port that exists" in state["link"]["error"]
        assert daemon.call("POST", "/v1/arm", status=503)["detail"]
        board = Board(tmp_path)
        try:
            wait_for(lambda: daemon.state()["link"]["state"] == "up", "the link", 10.0)
            assert daemon.arm()["board"]["state"] == "ARMED"
            board.process.kill()
            board.process.wait()
            state = wait_for(lambda: (s := daemon.state())["link"]["state"] == "down" and s, "the loss", 10.0)
            assert state["board"]["state"] not in ("ARMED", "RUNNING", "HOLD")
        finally:
            board.stop()
        assert daemon.process.poll() is None
    finally:
        daemon.stop()


def test_an_address_for_everybody_is_warned_about(make_board, tmp_path):
    board = make_board()
    daemon = Daemon(tmp_path, board.port, replace=build_daemon_replacement('host = "0.0.0.0"\nhosts = ["0.0.0.0"]'))
    daemon.stop()
    assert "0.0.0.0" in daemon.errors.read_text()
