"""`optodrive stop` while every other process of the daemon is stopped, with the real daemon and board process."""

import os
import signal

import pytest

from forked_process import run_process
from optodrive.daemon.runtime_folder import find_link_socket
from optodrive.link.service.link_connection import stop_board
from rig import OPTODRIVE, TOKEN, long_train, running, wait_for


def find_others(daemon):
    """Return the process ids of the daemon without its link process, the supervisor first, so that it restarts none."""
    link = daemon.find_process("link")
    assert link is not None
    return [daemon.process.pid, *(child for child in daemon.list_children() if child != link)]


@pytest.fixture
def suspended():
    """Return a function that suspends processes until the end of the test."""
    pids = []

    def suspend(found):
        pids.extend(found)
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)

    yield suspend
    for pid in reversed(pids):
        os.kill(pid, signal.SIGCONT)


def test_stop_needs_only_the_link_process(board, daemon, tmp_path, suspended):
    daemon.arm()
    daemon.call("POST", "/v1/plans", json=long_train(seconds=20.0))
    wait_for(lambda: len(board.of("pulse")) > 20, "pulses")
    others = find_others(daemon)
    assert len(others) == 5
    suspended(others)
    environment = {name: value for name, value in os.environ.items() if name != "OPTODRIVE_TOKEN"}  # none is needed
    ended = run_process(
        [OPTODRIVE, "stop", "--url", daemon.url],
        env=environment | {"XDG_RUNTIME_DIR": str(tmp_path), "OPTODRIVE_TOKENS": str(tmp_path / "none")},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stderr
    assert "the board was stopped" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert board.of("gate")[-1]["on"] is False
    assert board.of("state")[-1]["state"] in ("DISARMED", "FAULT")


@pytest.mark.parametrize("runtime", ["its own", "none"])
def test_a_misspelt_variable_is_told_only_after_the_stop(runtime, board, daemon, tmp_path):
    """By the link process's socket, and over HTTP where that is not found."""
    daemon.arm()
    daemon.call("POST", "/v1/plans", json=long_train(seconds=20.0))
    wait_for(lambda: board.of("pulse"), "light")
    folder = tmp_path if runtime == "its own" else tmp_path / "none"
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "XDG_RUNTIME_DIR": str(folder), "OPTODRIVE_ULR": "x"}
    ended = run_process([OPTODRIVE, "stop", "--url", daemon.url], env=environment, capture_output=True, text=True)
    assert ended.returncode == 2
    assert "DISARMED" in ended.stdout
    assert "environment: got 'OPTODRIVE_ULR'" in ended.stderr
    assert board.of("gate")[-1]["on"] is False
    assert daemon.board_state() == "DISARMED"


def test_a_second_daemon_on_the_same_socket_leaves_the_direct_stop_of_the_first(tmp_path):
    unix = tmp_path / "s"
    options = f'lease_s = 1.0\n[daemon]\nsocket = "{unix}"\n#'
    with running(tmp_path, replace=[("lease_s = 1.0", options)]) as (board, daemon):
        daemon.arm()
        second = run_process(
            [OPTODRIVE, "serve", "--config", daemon.config, "--port", "0"],
            env=os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
        )
        assert second.returncode == 2
        assert "daemon.socket: got" in second.stderr
        assert "Address already in use" in second.stderr
        stopped = stop_board(find_link_socket(None, unix))
        assert stopped is not None
        assert board.of("state")[-1]["state"] == "DISARMED"
        assert daemon.board_state() == "DISARMED"
