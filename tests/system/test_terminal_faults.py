"""Faults of a real terminal, injected by strace into the link process, which finds the board again."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from link_process_rig import LinkProcess
from optodrive.link.protocol.states import BoardState
from rig import PATIENT_LEASE_S, wait_for
from test_link_process import await_dark, emit
from test_stages import GOES_ON, Bench, build_trains

FAULTS = [
    ("write:error=ENODEV", "ENODEV", "openat:error=EPERM", "EPERM"),
    ("ioctl:error=EIO:when=2+", "EIO", "ioctl:error=EIO:when=2+", "EIO"),
    ("read:error=ENXIO", "ENXIO", "flock:error=EAGAIN", "EAGAIN"),
    ("read:retval=0", "returned no data", "openat:error=EMFILE", "EMFILE"),
    ("write:error=EIO", "EIO", "openat:error=EBUSY", "EBUSY"),
    ("read:error=EPROTO", "EPROTO", "openat:error=ENOENT", "exists"),
]
"""What fails while the port is open, what the message contains, and the same while it is opened again.

The second ioctl of an opening sets the line: pyserial lets `termios.error` of it pass.
"""


@pytest.fixture
def link(tmp_path, board):
    link = LinkProcess(tmp_path, board.port, lease_s=PATIENT_LEASE_S)
    link.open_planner()
    link.web = link.open_client("web")
    link.until(lambda: link.planner.connected)
    yield link
    link.stop()


class Injection:
    """Faults in the system calls of a process on a port, until `end`."""

    def __init__(self, pid, port, *faults):
        names = ",".join(sorted({fault.split(":")[0] for fault in faults}))
        options = [option for path in (port, os.path.realpath(port)) for option in ("-P", str(path))]
        options += [option for fault in faults for option in ("-e", f"inject={fault}")]
        command = ["strace", "-f", "-p", str(pid), "-o", "/dev/null", "-e", f"trace={names}", *options]
        self._process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        lines = []
        while not lines or (lines[-1] and "attached" not in lines[-1]):
            lines.append(self._process.stderr.readline())
        if not lines[-1]:
            self._process.communicate()
            pytest.skip(f"strace cannot attach here: {' '.join(lines).strip()}")

    def end(self):
        self._process.terminate()
        self._process.communicate()


needs_strace = pytest.mark.skipif(shutil.which("strace") is None, reason="strace is missing: apt-get install strace")


@needs_strace
@pytest.mark.parametrize(
    ("open_fault", "shown", "opening_fault", "shown_then"),
    [FAULTS[1], *(pytest.param(*each, marks=pytest.mark.slow) for each in FAULTS if each != FAULTS[1])],
)
def test_a_failing_port_is_a_lost_link_and_comes_back(link, board, open_fault, shown, opening_fault, shown_then):
    emit(link, board)
    injection = Injection(link.process.pid, board.port, *{open_fault, opening_fault})
    try:
        errors = []

        def look(words):
            assert link.process.poll() is None, "the link process has ended"
            errors.append(link.planner.link_error or "")
            return any(words in error for error in errors)

        link.until(lambda: look(shown) and look(shown_then))
        await_dark(board)
    finally:
        injection.end()
    link.until(lambda: link.planner.connected)
    assert link.process.poll() is None
    assert link.planner.board.state == BoardState.DISARMED


def test_stty_on_the_open_port_is_named_and_the_board_is_found_again(link, board):
    emit(link, board)
    device = os.path.realpath(board.port)
    subprocess.run(["stty", "-F", device, "sane"], check=True)
    link.until(lambda: "another program changed the settings" in (link.planner.link_error or ""))
    await_dark(board)
    link.until(lambda: link.planner.connected)
    assert Path(device).exists()
    wait_for(lambda: board.of("state")[-1]["state"] == BoardState.DISARMED, "the board")


@needs_strace
@pytest.mark.slow
@pytest.mark.parametrize(("open_fault", "shown", "opening_fault", "shown_then"), FAULTS)
def test_a_stage_whose_port_fails_and_returns_is_lost_alone(tmp_path, open_fault, shown, opening_fault, shown_then):
    bench = Bench(tmp_path, GOES_ON)
    _, right = bench.boards
    try:
        bench.arm()
        bench.begin(build_trains(30.0))
        link = bench.daemon.find_process("link")
        injection = Injection(link, right.port, *{open_fault, opening_fault})
        try:
            lost = wait_for(lambda: bench.daemon.state()["stages"][1]["lost"], "the loss")
            assert shown in lost
            wait_for(lambda: shown_then in (bench.daemon.state()["stages"][1]["error"] or ""), "the next opening")
            assert bench.daemon.state()["stages"][0]["board"]["state"] in ("ARMED", "RUNNING", "HOLD")
            await_dark(right)
        finally:
            injection.end()
        wait_for(lambda: bench.daemon.state()["stages"][1]["connected"], "the port's return")
        assert bench.daemon.find_process("link") == link
        assert right.of("state")[-1]["state"] == "DISARMED"
        bench.daemon.call("POST", "/v1/stop")
        bench.arm()
    finally:
        bench.stop()
