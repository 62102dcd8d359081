"""What the web process guarantees about STOP, on a real daemon: no push from before it, no wait for the planner."""

import json
import os
import signal
import socket
import time

import httpx
import pytest

from rig import TOKEN, long_train, wait_for


@pytest.fixture
def armed(kept):
    board, daemon = kept
    if daemon.board_state() == "DISARMED":
        daemon.arm()
    board.forget()
    return board, daemon


def open_push(daemon, body):
    """Send the header of a push and half of its body; return the socket and the other half."""
    link = socket.create_connection(("127.0.0.1", daemon.client.base_url.port), timeout=20)
    header = f"POST /v1/plans HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {TOKEN}\r\n"
    link.sendall(f"{header}Content-Length: {len(body)}\r\n\r\n".encode() + body[:20])
    time.sleep(0.2)
    return link, body[20:]


def receive_answer(link):
    answer = b""
    while b"\r\n\r\n" not in answer or not answer.endswith(b"}"):
        answer += link.recv(65_536)
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]), json.loads(body)


@pytest.mark.parametrize("command", ["stop", "disarm"])
def test_a_push_that_began_before_a_stop_is_never_lit(armed, command):
    board, daemon = armed
    link, rest = open_push(daemon, json.dumps(long_train(seconds=0.5)).encode())
    with link:
        daemon.call("POST", f"/v1/{command}")
        daemon.arm()
        link.sendall(rest)
        status, problem = receive_answer(link)
    assert (status, problem["code"]) == (409, "stopped")
    time.sleep(0.5)
    assert board.of("pulse") == []
    # The same push, begun after arming, is shown.
    link, rest = open_push(daemon, json.dumps(long_train(seconds=0.5)).encode())
    with link:
        link.sendall(rest)
        status, report = receive_answer(link)
    assert status == 201
    assert daemon.finished(report["plan"])["status"] == "done"
    assert board.of("pulse")


def test_stop_answers_while_the_planner_is_suspended(armed):
    board, daemon = armed
    daemon.call("POST", "/v1/plans", json=long_train())
    wait_for(lambda: len(board.of("pulse")) > 5, "pulses")
    planner = daemon.find_process("planner")
    os.kill(planner, signal.SIGSTOP)
    try:
        assert daemon.call("POST", "/v1/stop")["board"]["state"] == "DISARMED"
        assert board.of("gate")[-1]["on"] is False
    finally:
        os.kill(planner, signal.SIGCONT)


def test_stop_takes_effect_while_the_web_process_is_suspended_and_is_answered_afterwards(armed):
    board, daemon = armed
    daemon.call("POST", "/v1/plans", json=long_train())
    wait_for(lambda: len(board.of("pulse")) > 5, "pulses")
    web = daemon.find_process("web")
    os.kill(web, signal.SIGSTOP)
    try:
        with socket.create_connection(("127.0.0.1", daemon.client.base_url.port), timeout=20) as link:
            request = f"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {TOKEN}\r\n\r\n"
            link.sendall(request.encode())
            time.sleep(0.3)  # less than the age of a beat that costs the lease
            assert board.of("gate")[-1]["on"] is False
            assert board.of("state")[-1]["state"] == "DISARMED"
            os.kill(web, signal.SIGCONT)
            assert receive_answer(link)[0] == 200
    finally:
        os.kill(web, signal.SIGCONT)


@pytest.mark.parametrize("name", ["planner", "preview"])
def test_a_push_to_a_process_that_has_died_is_refused_in_one_line_and_the_next_is_served(armed, name):
    _, daemon = armed
    os.kill(daemon.find_process(name), signal.SIGKILL)
    seen = set()

    def is_served():
        response = daemon.client.post("/v1/plans?dry_run=true", json=long_train(seconds=0.1))
        seen.add(response.status_code)
        if response.status_code == 503:
            detail = response.json()["detail"]
            assert f"the {name} process does not run" in detail
            assert "\n" not in detail
        return response.status_code == 200

    wait_for(is_served, "the restarted process", 20.0)
    assert seen <= {200, 503}


def test_a_dry_run_whose_caller_leaves_is_dropped(armed):
    _, daemon = armed
    frames = [{"show_at_s": k * 2.0, "duration_s": 2.0, "target_um": [100.0] * 437} for k in range(1500)]
    with pytest.raises(httpx.ReadTimeout):
        daemon.client.post("/v1/plans?dry_run=true", json={"frames": frames}, timeout=1.0)
    begin_s = time.monotonic()
    assert daemon.call("POST", "/v1/plans?dry_run=true", json=long_train(seconds=0.1))["status"] == "planned"
    assert time.monotonic() - begin_s < 8.0
