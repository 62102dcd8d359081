"""Every command ends within seconds, in one line, when a process is killed or suspended; nothing is lit afterwards."""

import json
import os
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import pytest

from rig import OPTODRIVE, TOKEN, Board, Daemon, wait_for

END_S = 5.0
"""Maximum time from the loss to the end of the command."""
FRAMES = {"frames": [{"show_at_s": 0.0, "duration_s": 30.0, "target_um": {str(k): 300 for k in range(200, 400)}}]}
COMMANDS = {
    "play": ("play", "all", "height_um=150", "seconds=30"),
    "push": ("push", "frames.json"),
}
PROCESSES = ("board", "link", "planner", "web", "daemon")
SIGNALS = (signal.SIGKILL, signal.SIGSTOP)


def matrix():
    """Return all cases, of which one per process runs every time."""
    cases = []
    for row, process in enumerate(PROCESSES):
        for column, number in enumerate(SIGNALS):
            for place, command in enumerate(COMMANDS):
                is_every_time = column == (row + 1) % 2 and place == row // 2 % 2
                marks = [] if is_every_time else [pytest.mark.slow]
                name = f"{process}-{number.name}-{command}"
                cases.append(pytest.param(process, number, command, marks=marks, id=name))
    return cases


def find_pids(board, daemon, name):
    """Return the process ids of the board, of a process of the daemon, or of the whole daemon."""
    if name == "board":
        return [board.process.pid]
    children = daemon.list_children()
    if name == "daemon":
        return [daemon.process.pid, *children]
    titles = {pid: Path(f"/proc/{pid}/cmdline" if name == "link" else f"/proc/{pid}/comm") for pid in children}
    return [
        pid for pid in children if ("link.service" if name == "link" else f"opto-{name}") in titles[pid].read_text()
    ]


@pytest.fixture
def signalled():
    """Return a function that sends a signal to processes, which continue at the end of the test."""
    pids = []

    def send(number, found):
        pids.extend(found)
        for pid in found:
            os.kill(pid, number)

    yield send
    for pid in reversed(pids):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


@pytest.fixture
def rig(tmp_path):
    board = Board(tmp_path)
    try:
        daemon = Daemon(tmp_path, board.port)
        try:
            yield board, daemon
        finally:
            daemon.stop()
    finally:
        board.stop()


@pytest.mark.parametrize(("process", "number", "command"), matrix())
def test_a_command_that_shows_ends(rig, signalled, tmp_path, process, number, command):
    board, daemon = rig
    (tmp_path / "frames.json").write_text(json.dumps(FRAMES))
    daemon.arm()
    with subprocess.Popen(
        [OPTODRIVE, *COMMANDS[command]],
        cwd=tmp_path,
        env=os.environ | {"OPTODRIVE_URL": daemon.url, "OPTODRIVE_TOKEN": TOKEN},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as shown:
        wait_for(lambda: len(board.of("pulse")) > 10, "pulses")
        pids = find_pids(board, daemon, process)
        signalled(number, pids)
        lost_s = time.monotonic()
        try:
            _, errors = shown.communicate(timeout=30.0)
        except subprocess.TimeoutExpired:
            shown.kill()
            raise
        took_s = time.monotonic() - lost_s
    print(f"\n{process} {number.name} {command}: {took_s:.2f} s: {errors.strip()}")
    assert errors.count("\n") == 1
    assert errors.startswith("optodrive: ")
    assert shown.returncode == 1
    assert took_s <= END_S
    if process != "board":
        wait_for(lambda: not board.of("gate")[-1]["on"], "dark")
        pulses = len(board.of("pulse"))
        time.sleep(0.3)
        assert len(board.of("pulse")) == pulses
