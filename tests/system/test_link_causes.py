"""Link failures on a board process: reports of the state, the failed plan and the log, and link captures."""

import json
import os
import signal

from forked_process import run_process
from optodrive.link.transport.link_capture import LinkCapture
from rig import OPTODRIVE, PATIENT_LEASE_S, long_train, wait_for


def play(daemon, seconds=5.0):
    """Arm, start a train and return its id."""
    daemon.arm()
    plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=seconds))["plan"]
    wait_for(lambda: daemon.call("GET", f"/v1/plans/{plan}?pulses=false")["executed"], "light")
    return plan


def wait_for_cause(daemon, words):
    """Wait until the likely cause contains these words and the log has it, and return it."""

    def look():
        cause = daemon.state()["link"]["likely_cause"]
        return cause if cause and words in cause else None

    cause = wait_for(look, words)
    wait_for(lambda: cause in daemon.errors.read_text(), "the log's line")
    return cause


def test_a_killed_board_process_is_missing_and_the_timing_error_was_reported(board, daemon):
    first = daemon.call("POST", "/v1/plans", status=409, json=long_train())
    assert "arm it first" in first["detail"]
    plan = play(daemon, 0.1)
    answer = daemon.finished(plan)
    timing = answer["timing_error"]
    assert timing["pulses"] == answer["executed"] == 5
    # Without an underrun the timing error of the simulated board is below one tick.
    assert abs(timing["max_abs_s"]) <= 1e-6
    assert daemon.state()["totals"]["timing_error"]["pulses"] == 5
    plan = daemon.call("POST", "/v1/plans", json=long_train())["plan"]
    wait_for(lambda: daemon.call("GET", f"/v1/plans/{plan}?pulses=false")["executed"], "light")
    board.kill()
    cause = wait_for_cause(daemon, "is missing")
    assert str(board.port) in cause
    failed = daemon.finished(plan)
    assert failed["status"] == "failed"
    assert "likely cause: " in failed["error"]
    assert cause in failed["error"]


def test_a_stalled_host_is_named_and_its_session_captured(board, make_daemon, tmp_path):
    capture = tmp_path / "capture"
    daemon = make_daemon(board, options=("--capture", str(capture)))
    plan = play(daemon)
    pids = [daemon.process.pid, *daemon.list_children()]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: board.of("fault"), "the lease to expire")
    for pid in pids:
        os.kill(pid, signal.SIGCONT)
    cause = wait_for_cause(daemon, "this computer stalled")
    failed = daemon.finished(plan)
    assert cause in failed["error"]
    assert "FAULT (LINK: this computer" in failed["error"]
    daemon.stop()
    assert LinkCapture(capture).ignored_bytes == 0
    run = run_process([OPTODRIVE, "wire", "dump", capture, "--json"], capture_output=True, text=True, check=True)
    *lines, last = map(json.loads, run.stdout.splitlines())
    names = [line["message"] for line in lines if "message" in line]
    assert {"HELLO", "HELLO_REPLY", "ARM_CONFIRM", "DATA", "START", "EXECUTED", "LEASE"} <= set(names)
    assert names.count("HELLO") >= 1
    states = [line["fields"]["state"] for line in lines if line.get("message") == "EVENT"]
    assert states[:3] == ["ARMING", "ARMED", "RUNNING"]
    assert "FAULT" in states
    totals = last["totals"]
    assert totals["ignored_bytes"] == totals["bad_bytes"] == 0
    assert totals["host_silence_s"] > 0.5 * PATIENT_LEASE_S  # the lease ended in it
    assert totals["round_trip_min_s"] > 0


def test_a_capture_is_never_overwritten(board, tmp_path):
    capture = tmp_path / "capture"
    capture.write_text("precious")
    run = run_process([OPTODRIVE, "serve", "--port", "0", "--capture", capture], capture_output=True, text=True)
    assert run.returncode == 2
    assert run.stderr.splitlines()[-1].startswith("optodrive: --capture")
    assert capture.read_text() == "precious"
