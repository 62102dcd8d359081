"""Two boards under one daemon: simulated ones whose clocks drift, and the C core."""

import os
import signal
import subprocess
import time

import numpy as np
import pytest

from firmware_ports import build_board
from forked_process import SHORT_INDICATOR
from optodrive.link.simulator.board_clock import BoardClock
from rig import OPTODRIVE, PATIENT_LEAD_S, PATIENT_LEASE_S, TOKEN, Board, Daemon, long_train, wait_for

LEASE_S = PATIENT_LEASE_S
SKEW = ("[limits]\n", "[limits]\nstage_skew_max_s = 0.01\n")
"""Change of the configuration: on a busy computer an exchange with a board takes milliseconds."""
CLOCKS = BoardClock(50e-6), BoardClock(-50e-6, 10e-6)
DRIFTING = [
    [*SHORT_INDICATOR, "--clock-ppm", str(1e6 * clock.drift), "--clock-wander-ppm", str(1e6 * clock.wander)]
    for clock in CLOCKS
]
STAGE = """
[[stages]]
name = "{name}"
board = {{ transport = "serial", port = "{port}", lease_s = {lease_s}, stream_lead_s = {lead_s} }}
"""


def build_full_frame(height_um=60.0):
    return {"frames": [{"show_at_s": 0, "duration_s": 3, "target_um": {str(k): height_um for k in range(437)}}]}


def build_trains(seconds=5.0):
    trains = long_train(seconds=seconds)["trains"]
    return {"trains": [trains[0] | {"pixel": pixel} for pixel in (100, 300)]}


class Bench:
    """Two boards and a daemon."""

    def __init__(self, folder, programs):
        self.boards = []
        try:
            for name, program in zip(("left", "right"), programs, strict=True):
                own = folder / name
                own.mkdir()
                self.boards.append(Board(own, program=program))
            stages = "".join(
                STAGE.format(name=board.port.parent.name, port=board.port, lease_s=LEASE_S, lead_s=PATIENT_LEAD_S)
                for board in self.boards
            )
            self.daemon = Daemon(folder, self.boards[0].port, replace=[SKEW], stages=stages)
        except BaseException:
            self.stop_boards()
            raise

    def stop_boards(self):
        for board in self.boards:
            board.process.send_signal(signal.SIGCONT)
            board.stop()

    def stop(self):
        self.daemon.stop()
        self.stop_boards()

    def arm(self):
        wait_for(lambda: self.daemon.board_state() == "DISARMED", "both boards")
        time.sleep(1.0)  # until the clocks are known
        self.daemon.arm()

    def are_dark(self):
        gates = [board.of("gate") for board in self.boards]
        return all(not gate or not gate[-1]["on"] for gate in gates)


@pytest.fixture(params=["simulated", "firmware"])
def programs(request, tmp_path_factory):
    if request.param == "firmware":
        folder = tmp_path_factory.mktemp("firmware")
        return [build_board(folder)] * 2
    return DRIFTING


@pytest.fixture
def bench(programs, tmp_path):
    bench = Bench(tmp_path, programs)
    yield bench
    bench.stop()


@pytest.fixture
def drifting(tmp_path):
    bench = Bench(tmp_path, DRIFTING)
    yield bench
    bench.stop()


def list_true_s(board, clock):
    """Return the beginnings of a board's pulses in the host's time."""
    began_s = board.of("clock")[0]["monotonic_s"]
    return [began_s + clock.find_true_s(1e-6 * pulse["on_us"]) for pulse in board.of("pulse")]


def test_two_boards_draw_a_frame_and_stop_together(bench):
    bench.arm()
    answer = bench.daemon.finished(bench.daemon.call("POST", "/v1/plans", json=build_full_frame())["plan"])
    assert (answer["status"], answer["executed"]) == ("done", 437), answer["error"]
    counts = [len(board.of("pulse")) for board in bench.boards]
    assert sum(counts) == 437
    assert min(counts) > 150
    bench.daemon.call("POST", "/v1/plans", json=build_trains())
    wait_for(
        lambda: all(len(board.of("pulse")) > count + 5 for board, count in zip(bench.boards, counts, strict=True)),
        "trains",
    )
    state = bench.daemon.call("POST", "/v1/stop")
    assert [stage["board"]["state"] for stage in state["stages"]] == ["DISARMED", "DISARMED"]
    wait_for(bench.are_dark, "the logs")
    counts = [len(board.of("pulse")) for board in bench.boards]
    time.sleep(0.5)
    assert [len(board.of("pulse")) for board in bench.boards] == counts


def test_the_loss_of_one_board_darkens_the_other_within_its_lease(bench):
    bench.arm()
    bench.daemon.call("POST", "/v1/plans", json=build_trains())
    wait_for(lambda: all(len(board.of("pulse")) > 5 for board in bench.boards), "trains")
    lost, left = bench.boards
    lost.process.kill()
    killed_s = time.monotonic()
    wait_for(lambda: left.of("state")[-1]["state"] == "DISARMED", "the other board")
    assert time.monotonic() - killed_s < LEASE_S + 1.0
    assert not left.of("gate")[-1]["on"]
    state = bench.daemon.state()
    assert state["link"]["state"] == "down"
    assert "stage 'left'" in state["link"]["error"]


def test_clocks_that_drift_keep_the_host_s_time(drifting):
    drifting.arm()
    time.sleep(4.0)
    answer = drifting.daemon.finished(drifting.daemon.call("POST", "/v1/plans", json=build_trains(8.0))["plan"])
    assert answer["status"] == "done"
    planned_s, pixel = np.array(answer["pulses"]["start_s"]), np.array(answer["pulses"]["pixel"])
    true_s = [np.array(list_true_s(board, clock)) for board, clock in zip(drifting.boards, CLOCKS, strict=True)]
    spreads_s = []
    for first in (100, 300):  # whichever of the boards drew it
        errors_s = [true_s[0] - planned_s[pixel == first], true_s[1] - planned_s[pixel == 400 - first]]
        spreads_s.append(np.ptp(np.concatenate(errors_s)))
    assert min(spreads_s) < 1e-3
    drifts = [stage["clock_drift_ppm"] for stage in drifting.daemon.state()["stages"]]
    assert drifts == pytest.approx([50.0, -50.0], abs=30.0)


def test_status_shows_the_stages_and_the_commands_select_one(drifting, tmp_path):
    environment = {**os.environ, "OPTODRIVE_URL": drifting.daemon.url, "OPTODRIVE_TOKEN": TOKEN}

    def run(*arguments):
        done = subprocess.run([OPTODRIVE, *arguments], capture_output=True, text=True, env=environment, timeout=60)
        return done.returncode, done.stdout + done.stderr

    wait_for(lambda: drifting.daemon.board_state() == "DISARMED", "both boards")
    status, text = run("status")
    assert status == 0
    assert "stage     left at " in text
    assert "stage     right at " in text
    status, text = run("status", "--stage", "right")
    assert text.startswith("right at ")
    status, text = run("status", "--stage", "top")
    assert (status, text) == (2, "optodrive: --stage: got 'top', expected one of left, right\n")
    config = str(drifting.daemon.config)
    drifting.daemon.stop()
    text = run("home", "--stage", "right", "--config", config)[1]
    assert "right/tty" in text
    status, text = run("doctor", "--stage", "right", "--config", config)
    assert "right port" in text
    assert "left port" not in text
    status, text = run("home", "--config", config)
    assert (status, text) == (2, "optodrive: --stage: got None, expected one of left, right\n")
