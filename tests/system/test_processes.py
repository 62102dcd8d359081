"""Every process of the daemon dies, is stopped or is told to end, in every state of the board, by the board's log.

docs/reference/limits.md states the bounds; tests/unit/link/service holds them in virtual time.
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

from optodrive.core.processes import LIGHT, PLANNING
from optodrive.daemon.server import acceptor
from optodrive.daemon.server.acceptor import UNOPENED_MAX
from optodrive.daemon.server.connections import Rank
from optodrive.daemon.supervisor.child import HANG_S
from optodrive.daemon.supervisor.daemon import NICE
from rig import PATIENT_LEASE_S, TOKEN, Board, Daemon, is_alive, long_train, read_proc, wait_for
from signalled_processes import EMITTING_STATES, assert_dark_within_lease, assert_stayed_dark

PROCESSES = ("link", "planner", "preview", "acceptor", "web", "supervisor")
SIGNALS = (signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM)
SITUATIONS = ("idle", "armed", "streaming")
RESTARTS_MAX = 3
ESTABLISHED, LISTENS = "01", "0A"
"""States of a socket in /proc/net/tcp."""
AT_ONCE, PORT, LEASE = ("abort",), ("link lost",), ("fault",)
CAUSES = {
    ("link", signal.SIGKILL): PORT + LEASE,
    ("link", signal.SIGSTOP): LEASE,
    ("link", signal.SIGTERM): AT_ONCE,
    ("planner", signal.SIGKILL): AT_ONCE,
    ("planner", signal.SIGSTOP): LEASE + AT_ONCE,
    ("planner", signal.SIGTERM): AT_ONCE,
    ("acceptor", signal.SIGKILL): AT_ONCE,
    ("acceptor", signal.SIGSTOP): LEASE + AT_ONCE,
    ("acceptor", signal.SIGTERM): AT_ONCE,
    ("web", signal.SIGKILL): AT_ONCE,
    ("web", signal.SIGSTOP): LEASE + AT_ONCE,
    ("web", signal.SIGTERM): AT_ONCE,
    ("supervisor", signal.SIGKILL): AT_ONCE,
    ("supervisor", signal.SIGTERM): AT_ONCE,
}
"""What turns the gate off after a signal to a process. What is missing does not end a running plan.

The link process sends ABORT at the end of a connection (at once), lets the lease end without beats, or closes its port.
"""


def read_realtime_priority(pid, thread):
    """Return the real-time priority of a thread, 0 for a usual one.

    The name in parentheses may contain spaces.
    """
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


def await_dark(board, situation, causes):
    """Wait until a board has left its armed states, assert the cause, and return the number of its events by then."""
    if situation != "idle":
        wait_for(lambda: board.of("state") and board.of("state")[-1]["state"] not in EMITTING_STATES, "darkness")
        assert board.of("state")[-1]["reason"] in causes
        assert_dark_within_lease(board)
    return len(board.events())


def ask(daemon):
    """Return the state over a connection of its own.

    It is accepted at any time, and answered by the next process.
    """
    return httpx.get(f"{daemon.url}/v1/state", headers={"Authorization": f"Bearer {TOKEN}"}, timeout=None).json()


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
    os.kill(first, number)
    wait_for(lambda: rig.daemon.find_process(process) not in (None, first), f"another {process} process")
    causes = CAUSES.get((process, number))
    state = wait_for(
        lambda: (
            (s := ask(daemon))["link"]["state"] == "up"
            and s["planner"]["alive"]
            and (causes is None or s["board"]["state"] not in EMITTING_STATES)
            and s
        ),
        "the daemon to serve again",
    )
    wait_for(lambda: len(rig.restarts()[0]) > len(entries), "the audit entry")
    if causes is None:
        expected = {"idle": "DISARMED", "armed": "ARMED", "streaming": "RUNNING"}[situation]
        assert state["board"]["state"] == expected
        if situation == "streaming":  # the plan goes on; the new process may serve sooner than this shows
            emitted = len(board.of("pulse"))
            wait_for(lambda: len(board.of("pulse")) > emitted + 20, "the plan's later pulses")
    else:
        assert state["board"]["state"] in ("DISARMED", "FAULT")
        dark = await_dark(board, situation, causes)
        daemon.call("POST", "/v1/plans", status=409, json=long_train(seconds=0.1))
        assert_stayed_dark(board, dark)
    now_entries, now_lines = rig.restarts()
    assert [entry["process"] for entry in now_entries[len(entries) :]] == [process]
    assert len(now_lines) == len(lines) + 1
    assert process in now_lines[-1]


@pytest.mark.parametrize(("process", "number", "situation"), matrix(PROCESSES)[-9:])
def test_the_end_of_the_supervisor_leaves_the_board_dark_and_no_process(own, process, number, situation):
    rig, daemon, board = own, own.daemon, own.board
    rig.bring_to(situation)
    pids = [rig.daemon.find_process(name) for name in PROCESSES[:-1]]
    os.kill(daemon.process.pid, number)
    if number == signal.SIGSTOP:
        assert (
            ask(daemon)["board"]["state"] == {"idle": "DISARMED", "armed": "ARMED", "streaming": "RUNNING"}[situation]
        )
        time.sleep(HANG_S * 1.5)
        daemon.call("POST", "/v1/stop")
        dark = len(board.events())  # the log precedes the answer
        os.kill(daemon.process.pid, signal.SIGCONT)
        preview = PROCESSES.index("preview")
        os.kill(pids[preview], signal.SIGKILL)  # its restart shows that the supervisor has looked at its children
        wait_for(lambda: daemon.find_process("preview") not in (None, pids[preview]), "another preview process")
        pids[preview] = daemon.find_process("preview")
        assert [daemon.find_process(name) for name in PROCESSES[:-1]] == pids  # the beats of the meantime count
        assert_stayed_dark(board, dark)
        return
    assert daemon.process.wait() == (0 if number == signal.SIGTERM else -number)
    wait_for(lambda: not any(is_alive(pid) for pid in pids), "the end of the children")
    await_dark(board, situation, CAUSES[process, number])
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
        answers = [pool.submit(ask, shared.daemon) for _ in range(2 * UNOPENED_MAX[Rank.TOKEN])]
        wait_for(lambda: count_sockets(shared.daemon, "acceptor", ESTABLISHED) >= len(answers), "connections")
        os.kill(first, signal.SIGKILL)
        assert all(answer.result()["display"] for answer in answers)


def test_every_process_has_the_priority_of_the_daemon(shared):
    """Only the superuser may raise it."""
    niceness = {name: os.getpriority(os.PRIO_PROCESS, shared.daemon.find_process(name)) for name in PROCESSES}
    raised = dict.fromkeys(PROCESSES, NICE) | {"acceptor": acceptor.NICE}
    assert niceness == (raised if os.geteuid() == 0 else dict.fromkeys(PROCESSES, os.getpriority(os.PRIO_PROCESS, 0)))


def test_what_makes_dark_runs_before_the_planning_of_streams_and_that_before_all_else(shared):
    """Only the superuser may use real-time priorities."""
    shared.bring_to("streaming")
    pids = {name: shared.daemon.find_process(name) for name in PROCESSES}
    usual = dict.fromkeys(PROCESSES, 0)
    priorities = {name: read_realtime_priority(pid, pid) for name, pid in pids.items()}
    raised = usual | {"link": LIGHT, "acceptor": LIGHT, "planner": PLANNING}
    assert priorities == (raised if os.geteuid() == 0 else usual)
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
