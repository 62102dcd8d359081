"""`optodrive serve` plays an experiment on the Pico's image through its USB port, in the chip's time.

The daemon is the command as it is; its monotonic clock is the chip's (firmware_protocol/emulator/board_time.c), so that
both are late together.
"""

import json
import struct
import subprocess
import sys
from functools import partial

import pytest
from emulated_pico import EMULATION
from emulated_pico import HERE as PICO

import test_six_experiments as paper
from firmware_ports import require
from optodrive.link.simulator.emulated_pico import build_clock
from rig import Daemon, wait_for

BEGIN_NS = 1_000_000_000_000
LEASE_S = 0.1
UID = b"simulated001"
OFTEN = "\n[daemon]\nrequests_per_s = 1e5\nrequests_burst = 100000\n"
"""A second of the daemon is ten or more of the computer, in which a test polls it."""


class PicoProcess:
    """The Pico as a process, with its log, and the clock that it gives to its host."""

    def __init__(self, folder):
        self.port, self._log, self.time = folder / "tty", folder / "board.jsonl", folder / "time"
        self.time.write_bytes(struct.pack("<Q", BEGIN_NS))
        built = folder / "image"
        built.mkdir()
        arguments = ["--build", built, "--pty", self.port, "--log", self._log, "--time", self.time]
        self.process = subprocess.Popen([sys.executable, PICO / "board.py", *arguments])
        wait_for(lambda: self.port.exists() or self.process.poll() is not None, "the board's port")
        assert self.process.poll() is None

    def of(self, kind):
        """Return the log entries of a kind."""
        text = self._log.read_text()
        events = [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]
        return [event for event in events if event["event"] == kind]

    def stop(self):
        """End the process."""
        self.process.terminate()
        self.process.wait()


def make_clock(folder):
    """Build the library that gives a program the chip's time."""
    require("cc")
    library = folder / "board_time.so"
    build_clock(EMULATION / "board_time.c", library)
    return library


@pytest.fixture
def board(tmp_path):
    board = PicoProcess(tmp_path)
    yield board
    board.stop()


@pytest.fixture
def daemon(tmp_path, board, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setenv("BOARD_TIME", str(board.time))
        patched.setenv("LD_PRELOAD", str(make_clock(tmp_path)))
        daemon = Daemon(tmp_path, board.port, lease_s=LEASE_S, is_fresh=True, stages=OFTEN)
    yield daemon
    daemon.stop()


@pytest.mark.timeout(1200)
def test_experiment_1_is_played_by_the_daemon(board, daemon):
    """The chip's time is a tenth of the computer's: most of a minute is waiting."""
    wait_for(lambda: daemon.board_state() == "DISARMED", "the board")
    assert bytes.fromhex(daemon.state()["board"]["uid"]) == UID
    daemon.arm()
    paper.test_experiment_1_linear_motion(partial(paper.play, board, daemon))
    daemon.stop()
    wait_for(lambda: not board.of("port")[-1]["open"], "the end of the port")
    assert board.of("state")[-1]["state"] == "DISARMED"
    assert not board.of("gate")[-1]["on"]
