"""The supervisor over real children of a few lines: tiny_daemon.py states what each of them does."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest

from optodrive.daemon.supervisor.child import HANG_S
from optodrive.daemon.supervisor.supervisor import END_GRACE_S

PROGRAM = Path(__file__).with_name("tiny_daemon.py")
PATIENCE_S = 20.0
NOTICE_S = 1.0
"""Allowance for a busy machine, on top of a stated time."""
CHILDREN = ("link", "planner", "web")


class Tiny:
    def __init__(self, folder, **behaviours):
        self._notes = folder / "notes.jsonl"
        arguments = [f"{name}={behaviours.get(name, 'serve')}" for name in CHILDREN]
        self.process = subprocess.Popen(
            [sys.executable, PROGRAM, folder, *arguments], stderr=subprocess.PIPE, text=True
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


@pytest.fixture
def start(tmp_path):
    started = []

    def start_tiny(**behaviours):
        started.append(Tiny(tmp_path, **behaviours))
        return started[-1]

    yield start_tiny
    for tiny in started:
        tiny.process.kill()
        tiny.process.communicate()


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
    first = tiny.notes(f"{name} starts")[0]
    assert again["s"] - first["s"] < 0.3 + NOTICE_S
    assert [len(tiny.notes(f"{other} starts")) for other in CHILDREN if other != name] == [1, 1]


def test_a_child_that_hangs_is_killed_and_starts_again(start):
    tiny = start(planner="hang,serve")
    first, again = tiny.wait_for("planner starts"), tiny.wait_for("planner starts", 2)
    assert not Path(f"/proc/{first['pid']}").exists()
    assert 0.3 + HANG_S - 0.2 < again["s"] - first["s"] < 0.3 + HANG_S + NOTICE_S
    assert "no beat for 2 s" in tiny.wait_for("web receives")["fields"]["reason"]
    assert "no beat for 2 s" in tiny.end()


def test_a_stopped_child_is_killed_and_starts_again(start):
    tiny = start()
    tiny.wait_for("serves")
    os.kill(tiny.notes("web starts")[0]["pid"], signal.SIGSTOP)
    tiny.wait_for("web starts", 2)
    assert "the web process killed: no beat" in tiny.end()


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


def test_a_child_that_keeps_dying_starts_again_less_and_less_often(start):
    tiny = start(planner="die")
    times_s = [tiny.wait_for("planner starts", count)["s"] for count in (1, 2, 3, 4)]
    pauses_s = [after - before for before, after in pairwise(times_s)]
    assert pauses_s[0] < pauses_s[1] < pauses_s[2]


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


def test_the_watchdog_is_fed_only_while_all_children_serve(start, tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "200000")
        tiny = start(planner="die,die,die,serve")
        heard = []
        until = time.monotonic() + PATIENCE_S
        while heard.count("STATUS=board at tty, DISARMED") < 4:
            assert time.monotonic() < until, heard
            with suppress(BlockingIOError):
                heard += manager.recv(4096).decode().split("\n")
        tiny.end()
    assert heard.count("READY=1") == 1
    assert "STATUS=waiting for planner" in heard
    is_waiting = False
    for line in heard:
        if line.startswith("STATUS="):
            is_waiting = line == "STATUS=waiting for planner"
        assert not (is_waiting and line == "WATCHDOG=1"), heard
    assert heard.count("WATCHDOG=1") > 3


def stops_the_board_before_its_end(start):
    tiny = start()
    tiny.wait_for("serves")
    tiny.end()
    return bool(tiny.notes("link stops"))


def replaces_a_hung_child(start):
    tiny = start(planner="hang,serve")
    tiny.wait_for("planner starts")
    time.sleep(0.3 + HANG_S + NOTICE_S)
    return len(tiny.notes("planner starts")) == 2


def takes_a_hung_child_with_it(start):
    """Neither the end of the channel nor anything else reaches a child that hangs, except the kernel's signal."""
    tiny = start(planner="hang")
    tiny.wait_for("serves")
    time.sleep(0.5)
    tiny.process.kill()
    time.sleep(NOTICE_S)
    pids = [note["pid"] for note in tiny.notes() if note["event"].endswith("starts")]
    alive = [pid for pid in pids if is_alive(pid)]
    for pid in alive:
        os.kill(pid, signal.SIGKILL)
    return not alive


@pytest.mark.parametrize(
    ("holds", "mutant"),
    [
        (stops_the_board_before_its_end, "no STOP before the end"),
        (replaces_a_hung_child, "no death of a hung child"),
        (takes_a_hung_child_with_it, "no death with the supervisor"),
    ],
)
def test_each_check_is_there_and_its_absence_is_noticed(start, monkeypatch, tmp_path, holds, mutant):
    assert holds(start)
    (tmp_path / "notes.jsonl").unlink()
    monkeypatch.setenv("MUTANT", mutant)
    assert not holds(start)


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")")[1].split()[0] != "Z"
    except OSError:
        return False
