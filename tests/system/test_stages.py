"""Two boards under one daemon: simulated ones whose clocks drift, and the C core."""

import os
import signal
import subprocess
import time
from contextlib import suppress

import numpy as np
import pytest

from firmware_ports import build_board
from forked_process import FULL_INDICATOR
from optodrive.link.session.clock_sync import DRIFT_MAX
from optodrive.link.session.host_time import SEND_AHEAD_MAX_S
from optodrive.link.simulator.board_core import BoardClock
from rig import OPTODRIVE, PATIENT_LEAD_S, PATIENT_LEASE_S, TOKEN, Board, Daemon, long_train, wait_for
from signalled_processes import assert_dark_within_lease, assert_stayed_dark

LEASE_S = PATIENT_LEASE_S
SKEW_MAX_S = 0.01
PERIOD_S = 0.02
"""Time from one pulse of `long_train` to the next."""
SKEW = ("[limits]\n", f"[limits]\nstage_skew_max_s = {SKEW_MAX_S}\n")
"""Change of the configuration: on a busy computer an exchange with a board takes milliseconds."""
GOES_ON = '[daemon]\non_stage_loss = "that_stage"\n'
LATE = "light would have been"
"""Error of a plan whose points this computer did not hand over in time."""
CLOCKS = BoardClock(50e-6), BoardClock(-50e-6, 10e-6)
DRIFTING = [
    [*FULL_INDICATOR, "--clock-ppm", str(1e6 * clock.drift), "--clock-wander-ppm", str(1e6 * clock.wander)]
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
    """Two boards and a daemon. section: further text of the configuration."""

    def __init__(self, folder, programs, section=""):
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
            self.daemon = Daemon(folder, self.boards[0].port, replace=[SKEW], stages=section + stages)
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
        wait_for(lambda: self.find_clock_error_s() < SKEW_MAX_S, "the boards' clocks")
        self.daemon.arm()

    def run_command(self, *arguments):
        """Run a command against the daemon and return what it prints."""
        environment = {**os.environ, "OPTODRIVE_URL": self.daemon.url, "OPTODRIVE_TOKEN": TOKEN}
        done = subprocess.run([OPTODRIVE, *arguments], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def find_clock_error_s(self):
        """Return the largest uncertainty of a board's clock that the daemon states."""
        errors_us = [stage["clock_error_us"] for stage in self.daemon.state()["stages"]]
        return float("inf") if None in errors_us else 1e-6 * max(errors_us)

    def begin(self, body):
        """Push a plan, wait until both boards emit or the plan has ended, and return its id."""
        counts = [len(board.of("pulse")) for board in self.boards]
        plan = self.daemon.call("POST", "/v1/plans", json=body)["plan"]
        wait_for(
            lambda: (
                all(len(board.of("pulse")) > count + 5 for board, count in zip(self.boards, counts, strict=True))
                or self.daemon.call("GET", f"/v1/plans/{plan}")["status"] == "failed"
            ),
            "light",
        )
        return plan

    def await_end(self, plan):
        """Return the report of an ended plan, which emitted all of its pulses, or no more once they would be late."""
        answer = self.daemon.finished(plan)
        if answer["status"] == "failed":
            assert LATE in answer["error"]
            assert answer["executed"] < answer["planned"]
        else:
            assert (answer["status"], answer["executed"]) == ("done", answer["planned"]), answer["error"]
        assert sum(len(board.of("pulse")) for board in self.boards) == self.daemon.state()["totals"]["executed"]
        return answer


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
    answer = bench.await_end(bench.begin(build_full_frame()))
    assert answer["planned"] == 437
    if answer["status"] == "done":
        assert min(len(board.of("pulse")) for board in bench.boards) > 150
    bench.begin(build_trains())
    state = bench.daemon.call("POST", "/v1/stop")
    assert [stage["board"]["state"] for stage in state["stages"]] == ["DISARMED", "DISARMED"]
    begins = [len(board.events()) for board in bench.boards]  # the log precedes the answer
    bench.daemon.stop()
    for board, begin in zip(bench.boards, begins, strict=True):
        assert_stayed_dark(board, begin)
        assert not board.of("gate")[-1]["on"]


def test_the_loss_of_one_board_darkens_the_other_within_its_lease(bench):
    bench.arm()
    bench.begin(build_trains())
    lost, left = bench.boards
    lost.kill()
    wait_for(lambda: left.of("state")[-1]["state"] in ("DISARMED", "FAULT"), "the other board")
    assert_dark_within_lease(left)
    state = wait_for(lambda: (s := bench.daemon.state())["link"]["state"] == "down" and s, "the loss")
    assert "stage 'left'" in state["link"]["error"]


def fill(port):
    """Write to the terminal of a board that does not read until it has no room."""
    terminal = os.open(port.resolve(), os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        with suppress(BlockingIOError):
            while True:
                os.write(terminal, bytes(4096))
    finally:
        os.close(terminal)


@pytest.mark.parametrize("end", ["killed", "suspended", "full"])
def test_the_other_board_draws_what_is_left_where_configured(programs, tmp_path, end):
    bench = Bench(tmp_path, programs, GOES_ON)
    lost, left = bench.boards
    try:
        bench.arm()
        plan = bench.begin(build_trains(4.0))
        before = {(pulse["x"], pulse["y"]) for pulse in left.of("pulse")}
        assert len(before) == 1
        if end == "killed":
            lost.kill()
        else:
            lost.process.send_signal(signal.SIGSTOP)
        if end == "full":
            fill(lost.port)
        stages = wait_for(lambda: (s := bench.daemon.state()["stages"])[0]["lost"] and s, "the loss")
        assert (stages[0]["connected"], stages[1]["lost"]) == (False, None)
        assert ("accepts no bytes" in stages[0]["lost"]) == (end == "full")
        assert "stage     left at " in bench.run_command("status")
        assert ": lost, the others go on: " in bench.run_command("status")
        answer = bench.daemon.finished(plan)
        if answer["status"] == "failed":
            assert LATE in answer["error"]
        else:
            assert answer["status"] == "done", answer["error"]
            assert len({(pulse["x"], pulse["y"]) for pulse in left.of("pulse")}) == 2
        state = bench.daemon.call("POST", "/v1/stop")
        assert state["stages"][1]["board"]["state"] == "DISARMED"
        assert not left.of("gate")[-1]["on"]
        assert not left.of("fault")  # as it would have without a lease
    finally:
        bench.stop()


def test_light_that_would_be_late_is_not_emitted(bench):
    """The link process stands still until both boards have executed all points that they were sent ahead."""
    bench.arm()
    plan = bench.begin(build_trains(30.0))
    link = bench.daemon.find_process("link")
    os.kill(link, signal.SIGSTOP)
    try:
        wait_for(lambda: all(board.of("state")[-1]["state"] != "RUNNING" for board in bench.boards), "the last points")
        time.sleep(2 * PERIOD_S)  # until the next pulse would be late on every board
        begins = [len(board.events()) for board in bench.boards]
    finally:
        os.kill(link, signal.SIGCONT)
    assert bench.daemon.finished(plan)["status"] == "failed"
    for board, begin in zip(bench.boards, begins, strict=True):
        assert_stayed_dark(board, begin)


def test_boards_keep_the_host_s_time_as_exactly_as_the_daemon_states(drifting):
    drifting.arm()
    errors_s = [drifting.find_clock_error_s()]
    plan = drifting.begin(build_trains(8.0))

    def look():
        errors_s.append(drifting.find_clock_error_s())
        return drifting.daemon.call("GET", f"/v1/plans/{plan}")["status"] in ("done", "failed")

    wait_for(look, "the plan's end")
    answer = drifting.await_end(plan)
    planned_s, pixel = np.array(answer["pulses"]["start_s"]), np.array(answer["pulses"]["pixel"])
    true_s = [np.array(list_true_s(board, clock)) for board, clock in zip(drifting.boards, CLOCKS, strict=True)]
    spreads_s = []
    for first in (100, 300):  # whichever of the boards drew it
        late_s = [
            one_s - planned_s[pixel == number][: len(one_s)]
            for one_s, number in zip(true_s, (first, 400 - first), strict=True)
        ]
        spreads_s.append(np.ptp(np.concatenate(late_s)))
    assert min(spreads_s) <= 2.0 * (max(errors_s) + DRIFT_MAX * SEND_AHEAD_MAX_S)


def test_status_shows_the_stages_and_the_commands_select_one(drifting, tmp_path):
    environment = {**os.environ, "OPTODRIVE_URL": drifting.daemon.url, "OPTODRIVE_TOKEN": TOKEN}

    def run(*arguments):
        done = subprocess.run([OPTODRIVE, *arguments], capture_output=True, text=True, env=environment)
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
    status, text = run("doctor", "--stage", "top", "--config", config)
    assert (status, text) == (2, "optodrive: --stage: got 'top', expected one of left, right\n")
    status, text = run("doctor", "--stage", "right", "--config", config)
    assert "right port" in text
    assert "left port" not in text
    status, text = run("home", "--config", config)
    assert (status, text) == (2, "optodrive: --stage: missing, expected one of left, right\n")
