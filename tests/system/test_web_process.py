"""The web process's guarantees of STOP, on a real daemon: no push from before it, no wait for the planner."""

import json
import os
import signal
import socket
from contextlib import contextmanager, suppress

import pytest

from pushes import RawPush
from rig import TOKEN, is_suspended, long_train, wait_for


@pytest.fixture
def armed(kept):
    board, daemon = kept
    daemon.call("POST", "/v1/disarm")
    wait_for(lambda: daemon.client.post("/v1/arm").is_success, "processes that may arm")
    board.forget()
    return board, daemon


@contextmanager
def suspended(daemon, *names):
    """Suspend processes of a daemon, and yield their ids. Include the supervisor, which would end the others."""
    pids = [daemon.find_process(name) for name in names]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield pids
    finally:
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


@pytest.mark.parametrize("command", ["stop", "disarm"])
def test_a_push_that_began_before_a_stop_is_never_lit(armed, command):
    board, daemon = armed
    body = json.dumps(long_train(seconds=0.5)).encode()
    with RawPush(daemon, len(body)) as push:
        push.send(body[:20])
        daemon.call("POST", f"/v1/{command}")
        daemon.arm()
        push.send(body[20:])
        status, problem = push.receive()
    assert (status, problem["code"]) == (409, "stopped")
    # The same push, begun after arming, is shown; what was accepted before would be shown before it.
    with RawPush(daemon, len(body)) as push:
        push.send(body)
        status, report = push.receive()
    assert status == 201
    assert daemon.finished(report["plan"])["status"] == "done"
    assert len(board.of("pulse")) == report["planned"]


def test_stop_answers_while_the_planner_is_suspended(armed):
    board, daemon = armed
    daemon.call("POST", "/v1/plans", json=long_train())
    wait_for(lambda: len(board.of("pulse")) > 5, "pulses")
    with suspended(daemon, "supervisor", "planner") as (_, planner):
        state = daemon.call("POST", "/v1/stop")["board"]["state"]
        assert state in ("DISARMED", "FAULT")  # the latter if the lease, which a suspended planner ends, was faster
        assert board.of("gate")[-1]["on"] is False
        assert is_suspended(planner)


def test_stop_takes_effect_while_the_web_process_is_suspended_and_is_answered_afterwards(make_board, make_daemon):
    """Nothing but STOP ends the light: the lease does not depend on the web process."""
    board = make_board()
    daemon = make_daemon(board, replace=[("lease_s = 1.0", 'lease_s = 1.0\n[daemon]\non_web_loss = "finish"\n#')])
    daemon.arm()
    plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=60.0))["plan"]
    wait_for(lambda: len(board.of("pulse")) > 5, "pulses")
    with socket.create_connection(("127.0.0.1", daemon.client.base_url.port)) as link:
        with suspended(daemon, "supervisor", "web"):
            request = f"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {TOKEN}\r\n\r\n"
            link.sendall(request.encode())
            wait_for(lambda: board.of("state")[-1]["state"] == "DISARMED", "DISARMED")
            assert board.of("gate")[-1]["on"] is False
        assert link.recv(1 << 16).startswith(b"HTTP/1.1 200 ")
    assert daemon.finished(plan)["error"] == "ended by stop"


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

    wait_for(is_served, "the restarted process")
    assert seen <= {200, 503}
