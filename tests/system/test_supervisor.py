"""The supervisor over real children of a few lines, whose actions tiny_daemon.py states."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from optodrive.daemon.supervisor.child import HANG_S
from optodrive.daemon.supervisor.supervisor import END_GRACE_S
from rig import is_alive, wait_for

PROGRAM = Path(__file__).with_name("tiny_daemon.py")
ENDLESS_S = 1e6
"""Grace for the end of a child by which only those end that end by themselves."""
CHILDREN = ("link", "planner", "web")


class Tiny:
    def __init__(self, folder, environment=None, **behaviours):
        self._notes = folder / "notes.jsonl"
        arguments = [f"{name}={behaviours.get(name, 'serve')}" for name in CHILDREN]
        self.process = subprocess.Popen(
            [sys.executable, PROGRAM, folder, *arguments],
            env={**os.environ, "END_GRACE_S": str(ENDLESS_S), **(environment or {})},
            stderr=subprocess.PIPE,
            text=True,
        )

    def notes(self, event=None):
        lines = self._notes.read_text().splitlines(keepends=True) if self._notes.exists() else []
        notes = [json.loads(line) for line in lines if line.endswith("\n")]
        return [note for note in notes if event is None or note["event"] == event]

    def wait_for(self, event, count=1):
        return wait_for(lambda: len(self.notes(event)) >= count and self.notes(event)[count - 1], event)

    def list_pids(self):
        """Return the process ids of all children, by name."""
        return {note["event"].split()[0]: note["pid"] for note in self.notes() if note["event"].endswith("starts")}

    def end(self):
        self.process.terminate()
        return self.process.communicate()[1]


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    started = []

    def start_tiny(environment=None, **behaviours):
        started.append(Tiny(tmp_path_factory.mktemp("tiny"), environment, **behaviours))
        return started[-1]

    yield start_tiny
    for tiny in started:
        tiny.process.kill()
        tiny.process.wait()
        tiny.process.stderr.close()


WAITING = []


def waits(test):
    """Let a test that mostly waits run at once with the others of its kind, on the first of them."""
    WAITING.append(test)

    def test_outcome(outcomes):
        outcomes[test].result()

    return test_outcome


@pytest.fixture(scope="module")
def outcomes(start):
    with ThreadPoolExecutor(len(WAITING)) as pool:
        yield {test: pool.submit(test, start) for test in WAITING}


def test_a_quiet_life_ends_with_stop_first_and_leaves_no_process(start):
    tiny = start()
    tiny.wait_for("serves")
    errors = tiny.end()
    assert (tiny.process.returncode, errors) == (0, "")
    assert [note["event"] for note in tiny.notes()][-1] == "ended"
    [stop], [ended] = tiny.notes("link stops"), tiny.notes("ended")
    received = [(note["kind"], note.get("fields")) for note in tiny.notes("web receives")]
    assert received == [("audit", {"event": "ended"}), ("end", None)]
    for note in tiny.notes():
        if note["event"].endswith("starts"):
            assert not Path(f"/proc/{note['pid']}").exists()
    assert stop["s"] < ended["s"]
    assert {note["event"] for note in tiny.notes()} >= {f"{name} ends" for name in CHILDREN}, "none was killed"


def test_children_inherit_only_what_is_theirs(start):
    """0, 1, 2, the channel, and the listener of the tiny link."""
    tiny = start()
    tiny.wait_for("serves")
    assert {note["event"]: note["descriptors"] for note in tiny.notes() if "descriptors" in note} == {
        "link starts": 5,
        "planner starts": 4,
        "web starts": 4,
    }


@waits
def test_a_child_that_hangs_is_killed_and_starts_again(start):
    tiny = start(planner="hang,serve")
    hangs, _ = tiny.wait_for("planner hangs"), tiny.wait_for("planner starts", 2)
    assert not Path(f"/proc/{hangs['pid']}").exists()
    assert "no beat for 2 s" in tiny.wait_for("web receives")["fields"]["reason"]
    assert "no beat for 2 s" in tiny.end()


@waits
def test_without_its_check_a_child_that_hangs_stays(start):
    tiny = start({"MUTANT": "no death of a hung child"}, planner="hang,serve")
    tiny.wait_for("planner hangs")
    time.sleep(2 * HANG_S)
    assert len(tiny.notes("planner starts")) == 1


@waits
def test_a_child_that_ignores_sigterm_is_killed_after_the_grace(start):
    tiny = start({"END_GRACE_S": str(END_GRACE_S)}, planner="deaf")
    tiny.wait_for("serves")
    tiny.end()
    assert not Path(f"/proc/{tiny.list_pids()['planner']}").exists()


def test_a_stopped_child_ends_by_itself_with_the_daemon(start):
    tiny = start()
    tiny.wait_for("serves")
    os.kill(tiny.list_pids()["planner"], signal.SIGSTOP)
    tiny.end()
    assert tiny.notes("planner ends")


def test_a_child_that_cannot_serve_at_the_start_ends_the_daemon_with_its_reason(start):
    tiny = start(planner="fail")
    errors = tiny.process.communicate()[1]
    assert tiny.process.returncode == 1  # the command line turns it into the reported status
    assert errors.splitlines()[-1].endswith("StartError: capture: got 'x.jsonl', expected a new file")
    assert tiny.notes("serves") == []


@waits
def test_the_watchdog_is_fed_only_while_all_children_serve(start):
    with TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"{folder}/notify")
        tiny = start({"NOTIFY_SOCKET": f"{folder}/notify", "WATCHDOG_USEC": "200000"}, planner="die,die,serve")
        heard = []

        def is_fed():
            """Return whether the watchdog has been fed since the last status, which is that of a daemon that serves."""
            with suppress(BlockingIOError):
                while True:
                    heard.extend(manager.recv(4096, socket.MSG_DONTWAIT).decode().split("\n"))
            status = max((k for k, line in enumerate(heard) if line.startswith("STATUS=")), default=0)
            return heard[status:][:1] == ["STATUS=board at tty, DISARMED"] and "WATCHDOG=1" in heard[status:]

        wait_for(is_fed, "the watchdog to be fed")
        tiny.wait_for("planner starts", 3)  # the second death is reported before
        wait_for(is_fed, "the watchdog to be fed again")
        tiny.end()
    assert heard.count("READY=1") == 1
    assert "STATUS=waiting for planner" in heard
    is_waiting = False
    for line in heard:
        if line.startswith("STATUS="):
            is_waiting = line == "STATUS=waiting for planner"
        assert not (is_waiting and line == "WATCHDOG=1"), heard


def stops_the_board_before_its_end(start, environment):
    tiny = start(environment)
    tiny.wait_for("serves")
    tiny.end()
    return bool(tiny.notes("link stops"))


def kill_supervisor_of_a_hung_child(start, environment):
    """Return the process ids of the children of a supervisor that was killed, and that of the one that hangs.

    Neither the end of the channel nor anything else reaches a child that hangs, except the kernel's signal.
    """
    tiny = start(environment, planner="hang")
    tiny.wait_for("serves")
    tiny.wait_for("planner hangs")
    tiny.process.kill()
    pids = tiny.list_pids()
    return pids.values(), pids["planner"]


@waits
def test_the_board_is_stopped_before_the_end_and_the_absence_of_the_stop_is_noticed(start):
    assert stops_the_board_before_its_end(start, {})
    assert not stops_the_board_before_its_end(start, {"MUTANT": "no STOP before the end"})


@waits
def test_a_hung_child_ends_with_the_supervisor_and_the_absence_of_the_check_is_noticed(start):
    pids, _ = kill_supervisor_of_a_hung_child(start, {})
    wait_for(lambda: not any(map(is_alive, pids)), "the end of all children")
    pids, hung = kill_supervisor_of_a_hung_child(start, {"MUTANT": "no death with the supervisor"})
    wait_for(lambda: [pid for pid in pids if is_alive(pid)] == [hung], "the end of the other children")
    os.kill(hung, signal.SIGKILL)
