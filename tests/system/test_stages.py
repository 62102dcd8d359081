"""Two boards whose clocks drift under one daemon; tests/firmware/test_emulated_stages.py plays the C core."""

import os
import signal

import pytest

from forked_process import FULL_INDICATOR, run_process
from optodrive.link.simulator.board_core import BoardClock
from rig import OPTODRIVE, PATIENT_LEAD_S, PATIENT_LEASE_S, TOKEN, Board, Daemon, long_train, wait_for
from signalled_processes import assert_stayed_dark

LEASE_S = PATIENT_LEASE_S
SKEW_MAX_S = 0.01
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

    def __init__(self, folder, section=""):
        self.boards = []
        try:
            for name, program in zip(("left", "right"), DRIFTING, strict=True):
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
        done = run_process([OPTODRIVE, *arguments], capture_output=True, text=True, env=environment)
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


@pytest.fixture
def bench(tmp_path):
    bench = Bench(tmp_path)
    yield bench
    bench.stop()


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


def test_the_other_board_draws_what_is_left_where_configured(tmp_path):
    bench = Bench(tmp_path, GOES_ON)
    lost, left = bench.boards
    try:
        bench.arm()
        plan = bench.begin(build_trains(4.0))
        before = {(pulse["x"], pulse["y"]) for pulse in left.of("pulse")}
        assert len(before) == 1
        lost.kill()
        stages = wait_for(lambda: (s := bench.daemon.state()["stages"])[0]["lost"] and s, "the loss")
        assert (stages[0]["connected"], stages[1]["lost"]) == (False, None)
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


def test_status_shows_the_stages_and_the_commands_select_one(bench, tmp_path):
    environment = {**os.environ, "OPTODRIVE_URL": bench.daemon.url, "OPTODRIVE_TOKEN": TOKEN}

    def run(*arguments):
        done = run_process([OPTODRIVE, *arguments], capture_output=True, text=True, env=environment)
        return done.returncode, done.stdout + done.stderr

    wait_for(lambda: bench.daemon.board_state() == "DISARMED", "both boards")
    status, text = run("status")
    assert status == 0
    assert "stage     left at " in text
    assert "stage     right at " in text
    status, text = run("status", "--stage", "right")
    assert text.startswith("right at ")
    status, text = run("status", "--stage", "top")
    assert (status, text) == (2, "optodrive: --stage: got 'top', expected one of left, right\n")
    config = str(bench.daemon.config)
    bench.daemon.stop()
    text = run("home", "--stage", "right", "--config", config)[1]
    assert "right/tty" in text
    status, text = run("doctor", "--stage", "top", "--config", config)
    assert (status, text) == (2, "optodrive: --stage: got 'top', expected one of left, right\n")
    status, text = run("doctor", "--stage", "right", "--config", config)
    assert "right port" in text
    assert "left port" not in text
    status, text = run("home", "--config", config)
    assert (status, text) == (2, "optodrive: --stage: missing, expected one of left, right\n")
