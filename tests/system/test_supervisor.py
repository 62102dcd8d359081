"""The supervisor over real children of a few lines: tiny_daemon.py states what each of them does."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from optodrive.daemon.supervisor.child import HANG_S, RESTART_DELAYS_S
from optodrive.daemon.supervisor.supervisor import END_GRACE_S
from rig import is_alive
from tiny_daemon import LIFE_S

PROGRAM = Path(__file__).with_name("tiny_daemon.py")
PATIENCE_S = 20.0
NOTICE_S = 1.0
"""Allowance for a busy machine, on top of a stated time."""
CHILDREN = ("link", "planner", "web")


class Tiny:
    def __init__(self, folder, environment=None, **behaviours):
        self._notes = folder / "notes.jsonl"
        arguments = [f"{name}={behaviours.get(name, 'serve')}" for name in CHILDREN]
        self.process = subprocess.Popen(
            [sys.executable, PROGRAM, folder, *arguments],
            env={**os.environ, **(environment or {})},
            stderr=subprocess.PIPE,
            text=True,
        )

    def notes(self, event=None):
        lines = self._notes.read_text().splitlines(keepends=True) if self._notes.exists() else []
        notes = [json.loads(line) for line in lines if line.endswith("\n")]
        return [note for note in notes if event is None or note["event"] == event]

    def wait_for(self, event, count=1):
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            notes = self.notes(event)
            if len(notes) >= count:
                return notes[count - 1]
            time.sleep(0.01)
        raise AssertionError(f"no {event!r} number {count}: {self.notes()}")

    def end(self):
        self.process.terminate()
        return self.process.communicate(timeout=PATIENCE_S)[1]


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    started = []

    def start_tiny(environment=None, **behaviours):
        started.append(Tiny(tmp_path_factory.mktemp("tiny"), environment, **behaviours))
        return started[-1]

    yield start_tiny
    for tiny in started:
        tiny.process.kill()
        tiny.process.communicate()


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


def test_children_inherit_only_what_is_theirs(start):
    """0, 1, 2, the channel, and the listener of the tiny link."""
    tiny = start()
    tiny.wait_for("serves")
    assert {note["event"]: note["descriptors"] for note in tiny.notes() if "descriptors" in note} == {
        "link starts": 5,
        "planner starts": 4,
        "web starts": 4,
    }


@pytest.mark.parametrize("name", CHILDREN)
def test_a_child_that_dies_starts_again_with_one_line_and_one_audit_entry(start, name):
    tiny = start(**{name: "die,serve"})
    again = tiny.wait_for(f"{name} starts", 2)
    entry = tiny.wait_for("web receives")
    assert entry["fields"] == {"event": "restarted", "process": name, "reason": "ended with status 3"}
    errors = tiny.end()
    assert errors.count("\n") == 1, errors
    assert f"the {name} process ended with status 3" in errors
    assert again["s"] - tiny.notes("serves")[0]["s"] < LIFE_S + NOTICE_S
    assert [len(tiny.notes(f"{other} starts")) for other in CHILDREN if other != name] == [1, 1]


@waits
def test_a_child_that_hangs_is_killed_and_starts_again(start):
    tiny = start(planner="hang,serve")
    hangs, again = tiny.wait_for("planner hangs"), tiny.wait_for("planner starts", 2)
    assert not Path(f"/proc/{hangs['pid']}").exists()
    assert HANG_S - 0.2 < again["s"] - hangs["s"] < HANG_S + NOTICE_S
    assert "no beat for 2 s" in tiny.wait_for("web receives")["fields"]["reason"]
    assert "no beat for 2 s" in tiny.end()


@waits
def test_without_its_check_a_child_that_hangs_stays(start):
    tiny = start({"MUTANT": "no death of a hung child"}, planner="hang,serve")
    tiny.wait_for("planner hangs")
    time.sleep(HANG_S + NOTICE_S)
    assert len(tiny.notes("planner starts")) == 1


@waits
def test_a_stopped_child_is_killed_and_starts_again(start):
    tiny = start()
    tiny.wait_for("serves")
    os.kill(tiny.notes("web starts")[0]["pid"], signal.SIGSTOP)
    tiny.wait_for("web starts", 2)
    assert "the web process killed: no beat" in tiny.end()


@waits
def test_processes_that_were_stopped_together_continue_together(start):
    """Ctrl-Z and fg: the supervisor may run first again, and finds no beats of the meantime."""
    tiny = start()
    tiny.wait_for("serves")
    planner = tiny.notes("planner starts")[0]["pid"]
    for pid in (tiny.process.pid, planner):
        os.kill(pid, signal.SIGSTOP)
    time.sleep(HANG_S + 0.5)
    os.kill(tiny.process.pid, signal.SIGCONT)
    time.sleep(HANG_S / 4)
    os.kill(planner, signal.SIGCONT)
    time.sleep(HANG_S)
    assert is_alive(planner)
    assert tiny.end() == ""


@waits
def test_a_child_that_died_again_starts_after_a_pause(start):
    tiny = start(planner="die,die,serve")
    before, after = tiny.wait_for("planner starts", 2), tiny.wait_for("planner starts", 3)
    assert after["s"] - before["s"] > LIFE_S + RESTART_DELAYS_S[1]


@waits
def test_a_child_that_ignores_sigterm_is_killed_after_the_grace(start):
    tiny = start(planner="deaf")
    tiny.wait_for("serves")
    begun_s = time.monotonic()
    tiny.end()
    assert END_GRACE_S <= time.monotonic() - begun_s < 2 * END_GRACE_S + NOTICE_S
    assert not Path(f"/proc/{tiny.notes('planner starts')[0]['pid']}").exists()


def test_a_stopped_child_ends_at_once_with_the_daemon(start):
    tiny = start()
    tiny.wait_for("serves")
    os.kill(tiny.notes("planner starts")[0]["pid"], signal.SIGSTOP)
    begun_s = time.monotonic()
    tiny.end()
    assert time.monotonic() - begun_s < END_GRACE_S


def test_a_child_that_cannot_serve_at_the_start_ends_the_daemon_with_its_reason(start):
    tiny = start(planner="fail")
    errors = tiny.process.communicate(timeout=PATIENCE_S)[1]
    assert tiny.process.returncode == 1  # the command line turns it into the reported status
    assert errors.splitlines()[-1].endswith("StartError: capture: got 'x.jsonl', expected a new file")
    assert tiny.notes("serves") == []


@waits
def test_the_watchdog_is_fed_only_while_all_children_serve(start):
    with TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"{folder}/notify")
        manager.settimeout(PATIENCE_S)
        tiny = start({"NOTIFY_SOCKET": f"{folder}/notify", "WATCHDOG_USEC": "200000"}, planner="die,die,serve")
        heard = []
        until = time.monotonic() + PATIENCE_S
        while heard.count("STATUS=board at tty, DISARMED") < 3 or heard.count("WATCHDOG=1") <= 3:
            assert time.monotonic() < until, heard
            heard += manager.recv(4096).decode().split("\n")
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


def takes_a_hung_child_with_it(start, environment):
    """Neither the end of the channel nor anything else reaches a child that hangs, except the kernel's signal."""
    tiny = start(environment, planner="hang")
    tiny.wait_for("serves")
    tiny.wait_for("planner hangs")
    tiny.process.kill()
    time.sleep(NOTICE_S)
    pids = [note["pid"] for note in tiny.notes() if note["event"].endswith("starts")]
    alive = [pid for pid in pids if is_alive(pid)]
    for pid in alive:
        os.kill(pid, signal.SIGKILL)
    return not alive


@waits
def test_the_board_is_stopped_before_the_end_and_the_absence_of_the_stop_is_noticed(start):
    assert stops_the_board_before_its_end(start, {})
    assert not stops_the_board_before_its_end(start, {"MUTANT": "no STOP before the end"})


@waits
def test_a_hung_child_ends_with_the_supervisor_and_the_absence_of_the_check_is_noticed(start):
    assert takes_a_hung_child_with_it(start, {})
    assert not takes_a_hung_child_with_it(start, {"MUTANT": "no death with the supervisor"})
