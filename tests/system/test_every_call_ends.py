"""Every call ends, in one line, when a process is killed or suspended, and nothing is lit afterwards.

The cases are the product of call, stage, process and signal. A process that a call does not need does not end it.
"""

import asyncio
import json
import os
import subprocess
import threading

import pytest

from forked_process import OPTODRIVE, start_process
from optodrive.client import AsyncDisplay, Display
from optodrive.core.errors import OptodriveError
from rig import TOKEN, running, wait_for
from signalled_processes import (
    SIGNALS,
    assert_one_line,
    assert_stayed_dark,
    resume,
    signalling,
    wait_for_end,
    wait_until_dark,
)

PROCESSES = ("board", "link", "planner", "web", "acceptor", "preview", "supervisor", "daemon")
SHOWN = {"frames": [{"show_at_s": 0.0, "duration_s": 30.0, "target_um": {str(k): 300 for k in range(200, 400)}}]}
TRAIN = {"duration_s": 1800.0, "pulse_width_s": 0.0004, "gap_s": 0.1, "power_w": 0.02}
LONG_TO_PLAN = {"trains": [TRAIN | {"pixel": pixel, "start_s": 0.0025 * pixel} for pixel in range(40)]}
"""700,000 pulses: several seconds of planning."""
COMMANDS = {
    "play": ("play", "all", "height_um=150", "seconds=30"),
    "push": ("push", "shown.json"),
    "push-long": ("push", "long.json"),
    "hold": ("arm", "--hold"),
}
STAGES = {
    "play": ("showing",),
    "push": ("showing",),
    "push-long": ("planning",),
    "hold": ("arming", "held"),
    "stream": ("before", "frames", "closing"),
    "async-stream": ("before", "frames", "closing"),
}
UNNEEDED = ("preview-SIGKILL", "preview-SIGSTOP", "supervisor-SIGSTOP")
"""Faults that end no call."""
EVERY_TIME = {
    "play-showing-board-SIGSTOP",
    "push-showing-link-SIGKILL",
    "push-long-planning-planner-SIGKILL",
    "stream-frames-daemon-SIGSTOP",
    "play-showing-acceptor-SIGKILL",
}


def matrix():
    """Return all cases, of which five run every time."""
    cases = []
    for call, stages in STAGES.items():
        for stage in stages:
            for process in PROCESSES:
                for number in SIGNALS:
                    name = f"{call}-{stage}-{process}-{number.name}"
                    marks = [] if name in EVERY_TIME else [pytest.mark.slow]
                    cases.append(pytest.param(call, stage, process, number, marks=marks, id=name))
    return cases


def find_pids(board, daemon, name):
    """Return the process ids of the board, of a process of the daemon, or of the whole daemon."""
    if name == "board":
        return [board.process.pid]
    if name == "daemon":
        return [daemon.process.pid, *daemon.list_children()]
    return [daemon.find_process(name)]


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "shown.json").write_text(json.dumps(SHOWN))
    (tmp_path / "long.json").write_text(json.dumps(LONG_TO_PLAN))
    with running(tmp_path) as board_and_daemon:
        yield board_and_daemon


class CommandCall:
    """A call that is an `optodrive` command."""

    def __init__(self, folder, daemon, call):
        self._process = start_process(
            [OPTODRIVE, *COMMANDS[call]],
            cwd=folder,
            env=os.environ | {"OPTODRIVE_URL": daemon.url, "OPTODRIVE_TOKEN": TOKEN},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    @property
    def has_failed(self):
        return self._process.poll() not in (None, 0)

    def wait(self):
        """Wait until the call ends and return its line."""
        errors = wait_for_end(self._process)
        assert self._process.returncode == 1
        return assert_one_line(errors)

    def stop(self):
        self._process.kill()
        self._process.wait()
        self._process.stderr.close()


class StreamCall:
    """A call of the Python client that streams frames until it fails, in a thread.

    stage: at which it waits for go
    """

    def __init__(self, daemon, is_async, stage):
        self.frames, self.error, self._stage = 0, None, stage
        self.go, self.is_waiting = threading.Event(), threading.Event()
        self._ending = False
        run = (lambda: asyncio.run(self._run_async(daemon))) if is_async else (lambda: self._run(daemon))
        self._thread = threading.Thread(target=self._catch, args=(run,), daemon=True)
        self._thread.start()

    @property
    def has_failed(self):
        return self.error is not None

    def _catch(self, run):
        try:
            run()
        except OptodriveError as error:
            self.error = error

    def _pause(self, stage):
        if stage == self._stage:
            self.is_waiting.set()
            self.go.wait()

    def _heights(self):
        return {100 + self.frames % 50: 100.0}

    def _run(self, daemon):
        with Display(daemon.url, TOKEN) as display:
            display.state()
            self._pause("before")
            with display.stream() as stream:
                while not self._ending and (self._stage != "closing" or self.frames < 5):
                    stream.send(self._heights())
                    stream.wait()
                    self.frames += 1
                self._pause("closing")

    async def _run_async(self, daemon):
        async with AsyncDisplay(daemon.url, TOKEN) as display:
            await display.state()
            self._pause("before")
            async with display.stream() as stream:
                while not self._ending and (self._stage != "closing" or self.frames < 5):
                    await stream.send(self._heights())
                    await stream.wait()
                    self.frames += 1
                self._pause("closing")

    def wait(self):
        """Wait until the call ends and return its error, None if it had all that it needed."""
        self._thread.join()
        if self.error is not None:
            assert "\n" not in str(self.error)
            assert len(str(self.error)) > 20
        return self.error

    def stop(self):
        self._ending = True
        self.go.set()
        self._thread.join()


def start_call(call, stage, board, daemon, folder):
    """Start a call and return it when it has reached the stage."""
    if call != "hold":
        daemon.arm()
    if call.endswith("stream"):
        started = StreamCall(daemon, call == "async-stream", stage)
        wait_for(lambda: started.frames > 5 if stage == "frames" else started.is_waiting.is_set(), stage)
        return started
    started = CommandCall(folder, daemon, call)
    if stage == "showing":
        wait_for(lambda: len(board.of("pulse")) > 10, "pulses")
    elif stage == "planning":
        wait_for(lambda: daemon.state()["planner"]["busy"] or started.has_failed, "a busy planner")
        assert not started.has_failed, started.wait()
    else:
        state = "ARMING" if stage == "arming" else "ARMED"
        wait_for(lambda: any(event["state"] == state for event in board.of("state")), state)
    return started


def wait_for_the_restart(daemon, process, pid):
    """Wait until the daemon has replaced a process that it needs no more than a call does."""
    if process != "supervisor":
        wait_for(lambda: daemon.find_process(process) not in (None, pid), f"another {process} process")
    daemon.state()


@pytest.mark.parametrize(("call", "stage", "process", "number"), matrix())
def test_a_call_ends(rig, tmp_path, call, stage, process, number):
    board, daemon = rig
    started = start_call(call, stage, board, daemon, tmp_path)
    try:
        with signalling() as send:
            pids = find_pids(board, daemon, process)
            send(number, pids)
            if stage in ("before", "closing"):
                started.go.set()
            if f"{process}-{number.name}" in UNNEEDED:
                wait_for_the_restart(daemon, process, pids[0])
                assert not started.has_failed
                return
            line = started.wait()
            print(f"\n{line}")
            assert line or stage == "closing"
            if process == "board":
                resume(pids)
            dark = wait_until_dark(board)
        daemon.stop()
        assert_stayed_dark(board, dark)
    finally:
        started.stop()
