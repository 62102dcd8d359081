"""Every process of the daemon dies, is stopped or is told to end, in every state of the board, by the board's log.

docs/reference/limits.md states the bounds.
"""

import json
import os
import signal
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from optodrive.core.scheduling import LIGHT, PLANNING
from optodrive.daemon.priority import NICE
from optodrive.daemon.supervisor.child import HANG_S
from optodrive.daemon.web import acceptor
from optodrive.daemon.web.acceptor_client import PERMITTED
from optodrive.daemon.web.request_head import Rank
from rig import PATIENT_LEASE_S, TOKEN, Board, Daemon, is_alive, long_train, read_proc, wait_for

PROCESSES = ("link", "planner", "preview", "acceptor", "web", "supervisor")
SIGNALS = (signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM)
SITUATIONS = ("idle", "armed", "streaming")
RESTART_S = 3.0
RESTARTS_MAX = 3
AT_ONCE_S = 0.1
"""Aim for an end that the link process notices by the end of a connection."""
BEAT_TIMEOUT_S = 1.0
"""Age of a beat from which the link process no longer renews the lease."""
ESTABLISHED, LISTENS = "01", "0A"
"""States of a socket in /proc/net/tcp."""
LATENESS_S = 0.03
"""Maximum scheduling delay of the board process and of this test. The gate times in the log are exact."""
DARK_S = {
    ("link", signal.SIGKILL): PATIENT_LEASE_S,
    ("link", signal.SIGSTOP): PATIENT_LEASE_S,
    ("link", signal.SIGTERM): AT_ONCE_S,
    ("planner", signal.SIGKILL): AT_ONCE_S,
    ("planner", signal.SIGSTOP): BEAT_TIMEOUT_S + PATIENT_LEASE_S,
    ("planner", signal.SIGTERM): AT_ONCE_S,
    ("acceptor", signal.SIGKILL): AT_ONCE_S,
    ("acceptor", signal.SIGSTOP): BEAT_TIMEOUT_S + PATIENT_LEASE_S,
    ("acceptor", signal.SIGTERM): AT_ONCE_S,
    ("web", signal.SIGKILL): AT_ONCE_S,
    ("web", signal.SIGSTOP): BEAT_TIMEOUT_S + PATIENT_LEASE_S,
    ("web", signal.SIGTERM): AT_ONCE_S,
    ("supervisor", signal.SIGKILL): AT_ONCE_S,
    ("supervisor", signal.SIGTERM): AT_ONCE_S,
}
"""Time from a signal to a process until the gate stays off, s. What is missing does not end a running plan."""


def read_realtime_priority(pid, thread):
    """Return the real-time priority of a thread, 0 for a usual one; the name in parentheses may contain spaces."""
    return int(read_proc(pid, f"task/{thread}/stat").rpartition(")")[2].split()[37])


def matrix(processes):
    """Return all cases, of which a third runs every time: each process with each signal, in one situation."""
    cases = []
    for row, process in enumerate(processes):
        for column, number in enumerate(SIGNALS):
            for place, situation in enumerate(SITUATIONS):
                marks = [] if (row + column + place) % 3 == 2 else [pytest.mark.slow]
                name = f"{process}-{number.name}-{situation}"
                cases.append(pytest.param(process, number, situation, marks=marks, id=name))
    return cases


class Rig:
    """A board, a daemon with an audit file, and the processes of the daemon."""

    def __init__(self, folder, daemon_keys=""):
        self.board = Board(folder)
        self.audit = folder / "audit.jsonl"
        text = f'lease_s = {PATIENT_LEASE_S}\n[daemon]\naudit = "{self.audit}"\n{daemon_keys}#'
        self.daemon = Daemon(folder, self.board.port, replace=[(f"lease_s = {PATIENT_LEASE_S}", text)])

    def bring_to(self, situation):
        """Bring the board to a situation, from any other."""
        wait_for(lambda: ask(self.daemon)["link"]["state"] == "up", "the link")
        wait_for(lambda: ask(self.daemon)["planner"]["alive"], "the planner")
        self.daemon.call("POST", "/v1/stop")
        if self.daemon.board_state() == "FAULT":
            self.daemon.call("POST", "/v1/disarm")
        if situation != "idle":
            wait_for(lambda: self.daemon.client.post(f"{self.daemon.url}/v1/arm").is_success, "processes that may arm")
        self.board.forget()
        if situation == "streaming":
            self.daemon.call("POST", "/v1/plans", json=long_train(seconds=20.0))
            wait_for(lambda: len(self.board.of("pulse")) > 20, "pulses")

    def restarts(self):
        """Return the audit entries and the log lines about processes that started again."""
        entries = [json.loads(line) for line in self.audit.read_text().splitlines()] if self.audit.exists() else []
        lines = self.daemon.errors.read_text().splitlines()
        return [e for e in entries if e["event"] == "restarted"], [e for e in lines if "starts again" in e]

    def stop(self):
        try:
            self.daemon.stop()
        finally:
            self.board.stop()


def board_now_us(board):
    """Return the time of the last event in the board's log, which in a running plan is as good as now."""
    events = board.events()
    return events[-1]["t_us"] if events else 0


def assert_dark_within(board, since_us, bound_s):
    """Assert that the gate is off for good after a time; the lateness covers the reading of the log."""
    gates = board.of("gate")
    assert not gates or gates[-1]["on"] is False
    late = [gate for gate in gates if gate["on"] and gate["t_us"] > since_us + (bound_s + LATENESS_S) * 1e6]
    assert not late, (since_us, gates[-3:])
    assert not gates or gates[-1]["t_us"] <= since_us + (bound_s + LATENESS_S) * 1e6


def ask(daemon):
    """Return the state over a connection of its own; it is accepted at any time, and answered by the next process."""
    return httpx.get(f"{daemon.url}/v1/state", headers={"Authorization": f"Bearer {TOKEN}"}, timeout=10.0).json()


@pytest.fixture(scope="module")
def rigs(tmp_path_factory):
    """Return a list of the rigs, of which the last one runs."""
    started = [Rig(tmp_path_factory.mktemp("shared"))]
    yield started
    started[-1].stop()


@pytest.fixture
def shared(rigs, tmp_path_factory):
    """Return a rig for several tests, a new one before the supervisor delays the restart of a process noticeably."""
    if max(Counter(entry["process"] for entry in rigs[-1].restarts()[0]).values(), default=0) >= RESTARTS_MAX:
        rigs[-1].stop()
        rigs.append(Rig(tmp_path_factory.mktemp("shared")))
    return rigs[-1]


@pytest.fixture
def own(tmp_path):
    rig = Rig(tmp_path)
    yield rig
    rig.stop()


@pytest.mark.parametrize(("process", "number", "situation"), matrix(PROCESSES[:-1]))
def test_a_child_that_ends_leaves_the_board_dark_and_starts_again_disarmed(shared, process, number, situation):
    rig, daemon, board = shared, shared.daemon, shared.board
    rig.bring_to(situation)
    first, (entries, lines) = rig.daemon.find_process(process), rig.restarts()
    since_us, since_s = board_now_us(board), time.monotonic()
    os.kill(first, number)
    patience_s = RESTART_S + (HANG_S if number == signal.SIGSTOP else 0.0)
    wait_for(lambda: rig.daemon.find_process(process) not in (None, first), f"another {process} process", patience_s)
    bound_s = DARK_S.get((process, number))
    state = wait_for(
        lambda: (
            (s := ask(daemon))["link"]["state"] == "up"
            and s["planner"]["alive"]
            and (bound_s is None or s["board"]["state"] not in EMITTING_STATES)
            and s
        ),
        "the daemon to serve again",
        since_s + patience_s + LATENESS_S - time.monotonic(),
    )
    wait_for(lambda: len(rig.restarts()[0]) > len(entries), "the audit entry")
    if bound_s is None:
        expected = {"idle": "DISARMED", "armed": "ARMED", "streaming": "RUNNING"}[situation]
        assert state["board"]["state"] == expected
        if situation == "streaming":  # the plan goes on; the new process may serve sooner than this shows
            wait_for(lambda: board.of("gate")[-1]["t_us"] > since_us + 1e6 * HANG_S / 4, "the plan's later pulses")
    else:
        assert state["board"]["state"] in ("DISARMED", "FAULT")
        assert_dark_within(board, since_us, bound_s)
        pulses = len(board.of("pulse"))
        daemon.call("POST", "/v1/plans", status=409, json=long_train(seconds=0.1))
        assert len(board.of("pulse")) == pulses
    now_entries, now_lines = rig.restarts()
    assert [entry["process"] for entry in now_entries[len(entries) :]] == [process]
    assert len(now_lines) == len(lines) + 1
    assert process in now_lines[-1]


EMITTING_STATES = ("ARMED", "RUNNING", "ARMING")


@pytest.mark.parametrize(("process", "number", "situation"), matrix(PROCESSES)[-9:])
def test_the_end_of_the_supervisor_leaves_the_board_dark_and_no_process(own, process, number, situation):
    rig, daemon, board = own, own.daemon, own.board
    rig.bring_to(situation)
    pids = [rig.daemon.find_process(name) for name in PROCESSES[:-1]]
    since_us = board_now_us(board)
    os.kill(daemon.process.pid, number)
    if number == signal.SIGSTOP:
        assert (
            ask(daemon)["board"]["state"] == {"idle": "DISARMED", "armed": "ARMED", "streaming": "RUNNING"}[situation]
        )
        time.sleep(HANG_S * 1.5)
        daemon.call("POST", "/v1/stop")
        assert_dark_within(board, board_now_us(board), 0.0)  # by the answer, however late the request arrived
        os.kill(daemon.process.pid, signal.SIGCONT)
        time.sleep(0.5)
        assert [
            rig.daemon.find_process(name) for name in PROCESSES[:-1]
        ] == pids  # the beats of the meantime were not lost
        return
    assert daemon.process.wait(15) == (0 if number == signal.SIGTERM else -number)
    wait_for(lambda: not any(is_alive(pid) for pid in pids), "the end of the children", 1.0)
    wait_for(
        lambda: not board.of("state") or board.of("state")[-1]["state"] not in EMITTING_STATES, "the board to disarm"
    )
    assert_dark_within(board, since_us, DARK_S[process, number])
    assert "Traceback" not in daemon.errors.read_text()


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("web", signal.SIGKILL),
        *(
            pytest.param(name, number, marks=pytest.mark.slow)
            for name, number in (("web", signal.SIGSTOP), ("acceptor", signal.SIGKILL), ("acceptor", signal.SIGSTOP))
        ),
    ],
)
def test_a_plan_finishes_without_the_web_process_if_that_is_configured(tmp_path, name, number):
    rig = Rig(tmp_path, 'on_web_loss = "finish"\n')
    try:
        rig.bring_to("armed")
        plan = rig.daemon.call("POST", "/v1/plans", json=long_train(seconds=5.0))
        wait_for(lambda: len(rig.board.of("pulse")) > 20, "pulses")
        first = rig.daemon.find_process(name)
        os.kill(first, number)
        wait_for(lambda: rig.daemon.find_process(name) not in (None, first), f"another {name} process")
        wait_for(lambda: len(rig.board.of("pulse")) == plan["planned"], "the plan's last pulse")
        assert rig.board.of("fault") == []
    finally:
        rig.stop()


@pytest.mark.parametrize("name", ["acceptor", "web"])
def test_callers_are_not_refused_while_the_acceptor_or_the_web_process_is_away(shared, name):
    first = shared.daemon.find_process(name)
    os.kill(first, signal.SIGKILL)
    assert ask(shared.daemon)["display"]
    wait_for(lambda: shared.daemon.find_process(name) not in (None, first), f"another {name} process")


def test_connections_that_a_web_process_has_not_opened_at_its_end_are_opened_by_the_next(shared):
    first = shared.daemon.find_process("web")
    os.kill(first, signal.SIGSTOP)
    with ThreadPoolExecutor() as pool:
        answers = [pool.submit(ask, shared.daemon) for _ in range(2 * PERMITTED[Rank.TOKEN])]
        wait_for(lambda: count_sockets(shared.daemon, "acceptor", ESTABLISHED) >= len(answers), "connections")
        os.kill(first, signal.SIGKILL)
        assert all(answer.result()["display"] for answer in answers)


def test_every_process_has_the_priority_of_the_daemon(shared):
    if os.geteuid():
        pytest.skip("only the superuser may raise a priority")
    niceness = {name: os.getpriority(os.PRIO_PROCESS, shared.daemon.find_process(name)) for name in PROCESSES}
    assert niceness == dict.fromkeys(PROCESSES, NICE) | {"acceptor": acceptor.NICE}


def test_what_makes_dark_runs_before_the_planning_of_streams_and_that_before_all_else(shared):
    if os.geteuid():
        pytest.skip("only the superuser may use real-time priorities")
    shared.bring_to("streaming")
    pids = {name: shared.daemon.find_process(name) for name in PROCESSES}
    usual = dict.fromkeys(PROCESSES, 0)
    priorities = {name: read_realtime_priority(pid, pid) for name, pid in pids.items()}
    assert priorities == usual | {"link": LIGHT, "acceptor": LIGHT, "planner": PLANNING}
    threads = [int(path.name) for path in Path(f"/proc/{pids['planner']}/task").iterdir()]
    assert len(threads) > 2
    assert {read_realtime_priority(pids["planner"], thread) for thread in threads[1:]} == {0}


def test_the_supervisor_has_one_thread_and_children_hold_only_their_descriptors(shared):
    pid = shared.daemon.find_process("supervisor")
    assert len(list(Path(f"/proc/{pid}/task").iterdir())) == 1
    assert {name for name in PROCESSES if count_sockets(shared.daemon, name, LISTENS)} == {"supervisor", "acceptor"}


def count_sockets(daemon, name, state):
    """Return how many sockets in a state at the daemon's TCP port a process holds."""
    pid, port = daemon.find_process(name), int(daemon.url.rsplit(":")[-1])
    rows = [line.split() for line in Path(f"/proc/{pid}/net/tcp").read_text().splitlines()[1:]]
    inodes = {f"socket:[{row[9]}]" for row in rows if row[3] == state and int(row[1].split(":")[1], 16) == port}
    held = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):  # closed since
            held.add(str(descriptor.readlink()))
    return len(inodes & held)
