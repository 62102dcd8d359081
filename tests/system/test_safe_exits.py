"""Every kind of exit turns the gate off, according to the board's log."""

import os
import signal

import pytest

from rig import long_train, wait_for
from signalled_processes import assert_dark_within_lease, assert_stayed_dark


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


def test_sigstop_while_pulses_run(board, daemon):
    plan = start_pulses(board, daemon)
    pids = [daemon.process.pid, *daemon.list_children()]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: board.of("state")[-1]["state"] == "FAULT", "the board's fault")
    until_us = board.of("lease")[-1]["until_us"]
    assert board.of("fault") == [{"t_us": until_us, "event": "fault", "fault": "LINK"}]
    assert_off_and_unarmed(board, ("FAULT",))
    assert_dark_within_lease(board)
    dark = len(board.events())

    for pid in pids:
        os.kill(pid, signal.SIGCONT)
    answer = daemon.finished(plan)
    assert answer["status"] == "failed"
    assert "LINK" in answer["error"]
    assert daemon.board_state() == "FAULT"
    refused = daemon.call("POST", "/v1/arm", status=409)
    assert "LINK" in refused["detail"]
    assert daemon.call("POST", "/v1/disarm")["board"]["state"] == "DISARMED"
    assert daemon.arm()["board"]["state"] == "ARMED"
    assert_stayed_dark(board, dark)


def test_sigterm_while_pulses_run(board, make_daemon):
    daemon = make_daemon(board, is_fresh=True)
    start_pulses(board, daemon)
    daemon.stop()
    assert daemon.process.returncode == 0
    wait_for(lambda: board.of("state")[-1]["state"] == "DISARMED", "DISARMED")
    assert_off_and_unarmed(board, ("DISARMED",))
    assert board.of("state")[-1]["reason"] == "abort"
    assert "Traceback" not in daemon.errors.read_text()


def test_stop_while_pulses_run(board, daemon):
    plan = start_pulses(board, daemon)
    answer = daemon.call("POST", "/v1/stop")
    assert answer["board"]["state"] == "DISARMED"
    assert_off_and_unarmed(board, ("DISARMED",))
    stopped = daemon.finished(plan)
    assert stopped["status"] == "stopped"
    assert stopped["error"] == "ended by stop"
    assert 0 < stopped["executed"] < stopped["planned"]


def test_cancel_turns_the_gate_off_and_keeps_the_board_armed(board, daemon):
    plan = start_pulses(board, daemon)
    assert daemon.call("DELETE", f"/v1/plans/{plan}")["status"] == "cancelled"
    wait_for(lambda: board.of("state")[-1]["state"] == "ARMED", "ARMED")
    assert_off_and_unarmed(board, ("ARMED",))
    following = daemon.call("POST", "/v1/plans", json=long_train(seconds=0.1))["plan"]
    assert daemon.finished(following)["status"] == "done"


@pytest.mark.parametrize(
    "name", ["interlock", pytest.param("key", marks=pytest.mark.slow), pytest.param("estop", marks=pytest.mark.slow)]
)
def test_safety_inputs_end_a_plan_and_are_named(make_board, make_daemon, name):
    value = "true" if name == "estop" else "false"
    board = make_board(script=f'[[step]]\nfrom = "light"\nat_s = 1.0\nset = "{name}"\nvalue = {value}\n')
    daemon = make_daemon(board)
    plan = start_pulses(board, daemon, 30.0)
    answer = daemon.finished(plan)
    assert answer["status"] == "failed"
    assert name.upper() in answer["error"]
    fault, gate = board.of("fault")[-1], board.of("gate")[-1]
    assert gate["on"] is False
    assert gate["t_us"] <= fault["t_us"] + 1000
    daemon.call("POST", "/v1/disarm", status=409)


def test_unplugging_during_a_plan(make_board, make_daemon):
    board = make_board(script='[[step]]\nfrom = "light"\nat_s = 1.0\ndo = "close"\n')
    daemon = make_daemon(board)
    plan = start_pulses(board, daemon, 30.0)
    answer = daemon.finished(plan)
    assert answer["status"] == "failed"
    assert "lost" in answer["error"]
    assert 0 < answer["executed"] < answer["planned"]
    assert_off_and_unarmed(board, ("DISARMED",))
    state = wait_for(lambda: (s := daemon.state())["link"]["state"] == "up" and s, "the link to come back")
    assert state["board"]["state"] == "DISARMED"
    assert state["totals"]["executed"] == answer["executed"]
    assert "Traceback" not in daemon.errors.read_text()


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


def test_a_silent_board(make_board, make_daemon):
    steps = '[[step]]\nfrom = "light"\nat_s = 1.0\ndo = "hang"\n[[step]]\nfrom = "light"\nat_s = 5.0\ndo = "repair"\n'
    board = make_board(script=steps)
    daemon = make_daemon(board)
    plan = start_pulses(board, daemon, 30.0)
    answer = daemon.finished(plan)
    assert answer["status"] == "failed"
    assert "sent nothing" in answer["error"]
    assert_off_and_unarmed(board, ("FAULT", "DISARMED"))
    wait_for(lambda: daemon.state()["link"]["state"] == "up", "the link to come back")
