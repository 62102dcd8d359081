"""Every kind of exit turns the gate off, according to the board's log."""

from rig import long_train, wait_for
from signalled_processes import assert_dark_within_lease


def start_pulses(board, daemon, seconds=5.0):
    daemon.arm()
    plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=seconds))["plan"]
    wait_for(lambda: len(board.of("pulse")) > 20, "pulses")
    return plan


def ends(board):
    """Return the last gate edge and the last state in the log."""
    return board.of("gate")[-1], board.of("state")[-1]


def assert_off_and_unarmed(board, states):
    gate, state = ends(board)
    assert gate["on"] is False
    assert state["state"] in states


def test_kill_9_while_pulses_run(board, make_daemon):
    daemon = make_daemon(board)
    start_pulses(board, daemon)
    daemon.process.kill()
    daemon.process.wait()
    wait_for(lambda: board.of("state")[-1]["state"] in ("DISARMED", "FAULT"), "the board to leave RUNNING")
    assert_off_and_unarmed(board, ("DISARMED", "FAULT"))
    assert_dark_within_lease(board)

    again = make_daemon(board)
    assert again.board_state() in ("DISARMED", "FAULT")
    count = len(board.of("pulse"))
    again.call("POST", "/v1/plans", status=409, json=long_train())
    assert len(board.of("pulse")) == count


def test_a_full_disk_under_the_boards_log(make_board, make_daemon):
    board = make_board(disk_bytes=12_000)
    daemon = make_daemon(board)
    plan = start_pulses(board, daemon)
    assert board.process.wait() == 1
    assert board.process.stderr.read().count("\n") == 1
    assert not board.port.exists()
    answer = daemon.finished(plan)
    assert answer["status"] == "failed"
    assert "is missing" in answer["error"]
    assert daemon.state()["link"]["state"] == "down"
    assert "Traceback" not in daemon.errors.read_text()
