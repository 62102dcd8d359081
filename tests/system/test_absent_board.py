"""A daemon whose board is absent, or contradicts its configuration: it waits, says so, and finds the board."""

import time

import pytest

from rig import Board, Daemon, wait_for


@pytest.fixture
def start(tmp_path):
    """Return a function that starts a daemon on a board that may not be there."""
    daemons = []

    def start_daemon(port, **options):
        daemons.append(Daemon(tmp_path, port, **options))
        return daemons[-1]

    yield start_daemon
    for daemon in daemons:
        daemon.stop()


def test_a_board_that_comes_late_is_found(start, tmp_path):
    daemon = start(tmp_path / "tty")
    assert daemon.process.stdout.readline() == f"optodrive: waiting for the board at {tmp_path / 'tty'}\n"
    link = daemon.state()["link"]
    assert link["state"] == "down"
    assert "board.port" in link["error"]
    daemon.call("POST", "/v1/arm", status=503)
    wait_for(lambda: daemon.errors.read_text(), "the line about the board")
    time.sleep(2.0)  # of attempts
    errors = daemon.errors.read_text()
    assert errors.count("\n") == 1, errors
    assert str(tmp_path / "tty") in errors
    board = Board(tmp_path)
    try:
        line = daemon.process.stdout.readline()
        assert line == f"optodrive: board at {board.port}, DISARMED; arm with `optodrive arm --url {daemon.url}`\n"
        assert daemon.arm()["board"]["state"] == "ARMED"
    finally:
        daemon.stop()
        board.stop()
    assert daemon.process.returncode == 0


def test_a_board_that_contradicts_the_configuration_is_named(start, board):
    daemon = start(board.port, replace=[("max_power_w = 2.45", "max_power_w = 2.0")])
    wait_for(lambda: "laser.max_power_w" in daemon.errors.read_text(), "the line about the board")
    link = daemon.state()["link"]
    assert link["state"] == "down"
    assert "laser.max_power_w" in link["error"]
    daemon.call("POST", "/v1/arm", status=503)
    daemon.stop()
    errors = daemon.errors.read_text()
    assert errors.count("\n") == 1, errors
    assert "expected" in errors
