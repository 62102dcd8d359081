"""The heat of a board's display outlives daemons and commands as processes: stopped, and killed."""

import os
import signal

import pytest

from optodrive.core.clock import MonotonicClock
from optodrive.device.config_file import load_config
from optodrive.planning import heat_record
from optodrive.planning.display_model import DisplayModel
from rig import PATIENT_LEASE_S, is_alive, long_train, wait_for

UID = "0123456789abcdef01234567"
KILLED = "the process that used it last was killed"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return the folder of the records. That of the machine has none of a test."""
    folder = tmp_path / "heat"
    monkeypatch.setenv("HEAT_FOLDER", str(folder))
    monkeypatch.setattr(heat_record, "FOLDER", folder)
    return folder


@pytest.fixture
def board(make_board):
    return make_board(limits=f'uid = "{UID}"\nlease_ms = {PATIENT_LEASE_S * 1e3:.0f}\n')


def record_cold(config):
    display = DisplayModel.from_config(load_config(config))
    with heat_record.HeatRecord(heat_record.BOARDS, UID, display, MonotonicClock()) as record:
        record.save(display.build_cold_state()[1])


def read_reason(daemon):
    """Return why the display counts as hot, once the daemon knows it."""
    wait_for(lambda: daemon.board_state() != "UNKNOWN", "the board")
    wait_for(lambda: (daemon.config.parent / "heat" / f"board-{UID}").stat().st_size, "the record")
    return daemon.state()["limits"]["hot_reason"]


def emit(daemon):
    """Arm and play until light has come."""
    daemon.call("POST", "/v1/disarm")
    daemon.arm()
    plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=3.0))["plan"]
    wait_for(lambda: daemon.call("GET", f"/v1/plans/{plan}")["executed"], "light")


def kill_all(daemon):
    """Kill all processes of a daemon at once: none has time for a last word."""
    pids = [daemon.process.pid, *daemon.list_children()]
    for number in (signal.SIGSTOP, signal.SIGKILL):
        for pid in pids:
            os.kill(pid, number)
    daemon.process.wait()
    wait_for(lambda: not any(map(is_alive, pids)), "the end of all processes")


def test_a_stopped_daemon_leaves_its_heat_a_killed_one_a_hot_display(folder, board, make_daemon, start):
    first = make_daemon(board)
    assert read_reason(first) == "this machine had no record of its heat"
    assert first.state()["limits"]["hot_for_s"] > 0.0
    first.stop()
    record_cold(first.config)
    for _ in range(2):
        daemon = make_daemon(board)
        assert read_reason(daemon) == ""
        emit(daemon)
        daemon.stop()
    daemon = make_daemon(board)
    emit(daemon)
    kill_all(daemon)
    command = start(board, "first-light", "--yes", "--acknowledge")
    _, _, errors = command.ended()
    assert f"the display counts as hot, because {KILLED}; it cools within " in errors
    daemon = make_daemon(board)
    assert read_reason(daemon) == KILLED
    log = daemon.errors.read_text()
    assert f"the display counts as still warm, because {KILLED}; " in log
    assert "until then plans get less light" in log


def test_a_planner_that_starts_again_continues_with_its_heat(folder, board, make_daemon):
    daemon = make_daemon(board)
    daemon.stop()
    record_cold(daemon.config)
    daemon = make_daemon(board)
    emit(daemon)
    before = daemon.find_process("planner")
    os.kill(before, signal.SIGKILL)
    wait_for(lambda: daemon.find_process("planner") not in (None, before), "the next planner")
    wait_for(lambda: daemon.client.get("/metrics").is_success, "its answer, which follows its state")
    emit(daemon)
    assert daemon.state()["limits"]["hot_reason"] == ""
    daemon.stop()
    daemon = make_daemon(board)
    assert read_reason(daemon) == ""
