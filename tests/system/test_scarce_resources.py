"""Memory, disk and readers of the daemon's processes run out, in every state of the board, by the board's log."""

import fcntl
import os
import resource
import signal
import socket
import struct
import threading
import time
from contextlib import contextmanager, suppress
from functools import partial

import httpx
import pytest

from rig import TOKEN, Board, Daemon, is_alive, long_train, wait_for
from signalled_processes import assert_dark_within_lease, wait_until_dark
from test_processes import (
    EMITTING_STATES,
    PROCESSES,
    SITUATIONS,
    Rig,
    ask,
    rigs,
    shared,
)

__all__ = ("rigs", "shared")
RESTART_S = 3.0
"""Time for which a supervisor without memory is left to itself."""
FILLED = ("link", "planner", "preview", "web")
"""Processes that callers and other processes can send much; the acceptor reads a few kilobytes at once."""
STARVED_BYTES = 1 << 20
"""Memory that a process may have, less than it has already: every further allocation of memory fails."""
FILLING_BYTES = 30_000_000
"""More than a process has left of the memory that it had before."""


def bring(rig, situation):
    """Bring the board to a situation, with all processes connected to each other again."""
    await_service(rig.daemon)
    rig.bring_to(situation)


def await_service(daemon):
    """Wait until a dry run is answered, which takes web, preview and planner."""
    request = partial(daemon.client.post, "/v1/plans", params={"dry_run": True}, json=long_train(seconds=0.1))
    wait_for(lambda: request().is_success, "a dry run")


def starve(pid):
    """Let every further allocation of memory of a process fail."""
    resource.prlimit(pid, resource.RLIMIT_DATA, (STARVED_BYTES, resource.RLIM_INFINITY))


def fill(rig, process):
    """Send a process more than its memory holds: a long message, or to the web process a long body.

    What it does on its own may have ended it before.
    """
    base = rig.daemon.client.base_url
    if process == "web":
        head = f"POST /v1/plans HTTP/1.1\r\nHost: {base.host}:{base.port}\r\nAuthorization: Bearer {TOKEN}\r\n"
        head, body_bytes = head + "Content-Length: 7000000\r\n\r\n", 7_000_000
        family, address = socket.AF_INET, (base.host, base.port)
        data = head.encode() + bytes(body_bytes)
    else:
        folder = rig.daemon.config.parent / "optodrive" / f"daemon-{base.port}"
        family, address = socket.AF_UNIX, os.path.realpath(folder) + f"/{process}.sock"
        data = struct.pack("<II", 2 * FILLING_BYTES, 100) + bytes(FILLING_BYTES)
    with socket.socket(family, socket.SOCK_STREAM) as link, suppress(OSError):
        link.connect(address)
        link.sendall(data)
        link.shutdown(socket.SHUT_WR)  # its successor would wait for the rest
        link.recv(1)


def await_restart(rig, process, first, entries, lines):
    """Wait until another process serves in place of the first, and assert one line each in log and audit file.

    `test_processes` measures how long that takes.
    """
    wait_for(lambda: rig.daemon.find_process(process) not in (None, first), f"another {process} process")
    wait_for(lambda: (s := ask(rig.daemon))["link"]["state"] == "up" and s["planner"]["alive"], "the daemon to serve")
    wait_for(lambda: len(rig.restarts()[0]) > len(entries), "the audit entry")
    now_entries, now_lines = rig.restarts()
    assert [entry["process"] for entry in now_entries[len(entries) :]] == [process]
    assert len(now_lines) == len(lines) + 1
    return now_lines[-1]


def assert_refuses_plans(rig):
    pulses = len(rig.board.of("pulse"))
    rig.daemon.call("POST", "/v1/plans", status=409, json=long_train(seconds=0.1))
    assert len(rig.board.of("pulse")) == pulses


def slow_unless(chosen, *names):
    """Return the parameters of all combinations of names, slow except for the chosen ones."""
    combinations = [()]
    for values in names:
        combinations = [(*combination, value) for combination in combinations for value in values]
    return [
        pytest.param(*values, marks=[] if values in chosen else [pytest.mark.slow], id="-".join(values))
        for values in combinations
    ]


# --- memory ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("process", "situation"),
    slow_unless(
        {("link", "streaming"), ("planner", "streaming"), ("web", "streaming"), ("preview", "idle")},
        FILLED,
        SITUATIONS,
    ),
)
def test_a_process_without_memory_leaves_the_board_dark_and_starts_again(shared, process, situation):
    rig = shared
    bring(rig, situation)
    first, (entries, lines) = rig.daemon.find_process(process), rig.restarts()
    log_bytes = rig.daemon.errors.stat().st_size
    starve(first)
    fill(rig, process)
    line = await_restart(rig, process, first, entries, lines)
    assert f"the {process} process ended with status 1: out of memory" in line
    assert rig.daemon.errors.stat().st_size < log_bytes + 1000
    if process == "preview":
        expected = {"idle": "DISARMED", "armed": "ARMED", "streaming": "RUNNING"}[situation]
        assert ask(rig.daemon)["board"]["state"] == expected
    else:
        assert ask(rig.daemon)["board"]["state"] not in EMITTING_STATES
        wait_until_dark(rig.board)
        assert_dark_within_lease(rig.board)
        assert_refuses_plans(rig)


def test_a_request_that_takes_the_planners_memory_is_refused_or_ends_it_dark(shared):
    rig = shared
    bring(rig, "armed")
    first = rig.daemon.find_process("planner")
    starve(first)
    response = rig.daemon.client.post("/v1/plans", json=long_train(seconds=200.0))
    assert response.status_code in (500, 503)
    assert rig.board.of("pulse") == []
    with suppress(ProcessLookupError):  # it has ended
        os.kill(first, signal.SIGKILL)
    wait_for(lambda: ask(rig.daemon)["board"]["state"] == "DISARMED", "the board to disarm")


@pytest.mark.slow
@pytest.mark.parametrize("situation", SITUATIONS)
def test_a_supervisor_without_memory_keeps_the_board_under_control(tmp_path, situation):
    rig = Rig(tmp_path)
    try:
        bring(rig, situation)
        starve(rig.daemon.find_process("supervisor"))
        os.kill(rig.daemon.find_process("preview"), signal.SIGKILL)
        time.sleep(RESTART_S)
        if rig.daemon.process.poll() is None:
            headers = {"Authorization": f"Bearer {TOKEN}"}
            assert httpx.post(f"{rig.daemon.url}/v1/stop", headers=headers, timeout=None).is_success
        wait_for(lambda: rig.board.of("state") == [] or rig.board.of("state")[-1]["state"] == "DISARMED", "DISARMED")
        gates = rig.board.of("gate")
        assert not gates or gates[-1]["on"] is False
    finally:
        rig.stop()


# --- disk -----------------------------------------------------------------------------------------------------------


@contextmanager
def full_disk(rig):
    """Let no process of the daemon write to any file, as on a full disk. Files open before are limited, too."""
    pids = [rig.daemon.find_process(name) for name in PROCESSES]
    for pid in pids:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
    try:
        yield
    finally:
        for pid in {rig.daemon.find_process(name) for name in PROCESSES} | {pid for pid in pids if is_alive(pid)}:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


@pytest.mark.parametrize("process", ["link", *(pytest.param(name, marks=pytest.mark.slow) for name in PROCESSES[1:-1])])
def test_a_full_disk_behind_everything_costs_lines_and_arming_only(tmp_path, process):
    """Log, audit file and runtime folder are on it. The killed process starts again all the same."""
    rig = Rig(tmp_path)
    daemon, board = rig.daemon, rig.board
    try:
        bring(rig, "streaming")
        with full_disk(rig):
            pulses = len(board.of("pulse"))
            wait_for(lambda: len(board.of("pulse")) > pulses + 10, "further pulses")
            first = rig.daemon.find_process(process)
            os.kill(first, signal.SIGKILL)
            wait_for(lambda: rig.daemon.find_process(process) not in (None, first), "another process")
            wait_for(lambda: ask(daemon)["link"]["state"] == "up", "the link")
            if process != "preview":
                wait_until_dark(board)
                assert_dark_within_lease(board)
            stopped = daemon.call("POST", "/v1/stop")["board"]
            assert stopped["state"] in ("DISARMED", "FAULT")
            daemon.client.post("/v1/disarm")
            assert daemon.call("POST", "/v1/arm", status=409)["code"] == "audit_unavailable"
        bring(rig, "streaming")
        assert "Traceback" not in daemon.errors.read_text()
    finally:
        rig.stop()


# --- readers --------------------------------------------------------------------------------------------------------


def test_a_log_that_nobody_reads_keeps_no_process_from_its_work(tmp_path):
    """A pipe to a pager that was stopped, for example."""
    os.mkfifo(tmp_path / "daemon.err")
    reader = os.open(tmp_path / "daemon.err", os.O_RDONLY | os.O_NONBLOCK)
    fcntl.fcntl(reader, fcntl.F_SETPIPE_SZ, 4096)
    board = Board(tmp_path)
    daemon = Daemon(tmp_path, board.port)
    find = daemon.find_process
    try:
        with (tmp_path / "daemon.err").open("wb", buffering=0) as pipe:
            os.set_blocking(pipe.fileno(), False)
            while pipe.write(bytes(512)):
                pass
        daemon.arm()
        for _ in range(2):
            first = find("preview")
            os.kill(first, signal.SIGKILL)
            wait_for(lambda gone=first: find("preview") not in (None, gone), "another preview process")
        await_service(daemon)
        daemon.call("POST", "/v1/plans", json=long_train(seconds=20.0))
        wait_for(lambda: len(board.of("pulse")) > 5, "pulses")
        first = find("planner")
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: find("planner") not in (None, first), "another planner process")
        wait_until_dark(board)
        assert_dark_within_lease(board)
        daemon.process.terminate()
        assert daemon.process.wait() == 0
    finally:
        os.close(reader)
        daemon.stop()
        board.stop()


def test_a_process_that_reads_nothing_costs_only_its_own_requests(shared):
    """The preview process is stopped while callers send it more than its socket holds."""
    rig = shared
    bring(rig, "streaming")
    first = rig.daemon.find_process("preview")
    os.kill(first, signal.SIGSTOP)
    statuses = []

    def push():
        with suppress(httpx.HTTPError):
            headers = {"Authorization": f"Bearer {TOKEN}"}
            body = b'{"frames": [' + b" " * 1_000_000
            statuses.append(httpx.post(f"{rig.daemon.url}/v1/plans", content=body, headers=headers, timeout=None))

    callers = [threading.Thread(target=push) for _ in range(3)]
    for caller in callers:
        caller.start()
    pulses = len(rig.board.of("pulse"))
    wait_for(lambda: len(rig.board.of("pulse")) > pulses + 20, "pulses all the time")
    wait_for(lambda: rig.daemon.find_process("preview") not in (None, first), "another preview process")
    for caller in callers:
        caller.join()
    assert {answer.status_code for answer in statuses} <= {422, 429, 503}
    assert {event["reason"] for event in rig.board.of("state")} <= {"start", "job done"}
    assert rig.board.of("fault") == []


# --- in between -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("process", "moment"),
    slow_unless(
        {("link", "arming"), ("planner", "planning"), ("web", "stopping")},
        PROCESSES[:-1],
        ("arming", "planning", "stopping"),
    ),
)
@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)])
def test_a_process_that_ends_in_between_leaves_nothing_to_be_lit_later(shared, process, moment, number):
    """While the board shows its indicator, while a long plan is made, or while STOP is on its way."""
    rig = shared
    daemon, board = rig.daemon, rig.board
    bring(rig, "streaming" if moment == "stopping" else "armed")
    if moment == "arming":
        daemon.call("POST", "/v1/disarm")
    first, (entries, lines) = rig.daemon.find_process(process), rig.restarts()
    path, body = {
        "arming": ("/v1/arm", None),
        "planning": ("/v1/plans", long_train(seconds=600.0)),
        "stopping": ("/v1/stop", None),
    }[moment]

    def call():
        with suppress(httpx.HTTPError):
            httpx.post(f"{daemon.url}{path}", json=body, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=None)

    caller = threading.Thread(target=call)
    if moment == "stopping":
        os.kill(first, number)
        caller.start()
    else:
        caller.start()
        if moment == "arming":
            wait_for(lambda: any(event["state"] == "ARMING" for event in board.of("state")), moment)
        else:  # on a busy machine the plan may be made before it is seen
            wait_for(lambda: ask(daemon)["planner"]["busy"] or not caller.is_alive(), moment)
        os.kill(first, number)
    await_restart(rig, process, first, entries, lines)
    caller.join()
    if process == "preview":  # nothing depends on it
        daemon.call("POST", "/v1/stop")
    elif moment == "stopping":
        wait_until_dark(board)
        assert_dark_within_lease(board)
    wait_for(lambda: ask(daemon)["board"]["state"] in ("DISARMED", "FAULT"), "a board that is not armed")
    pulses = len(board.of("pulse"))
    daemon.client.post("/v1/disarm")
    wait_for(lambda: daemon.client.post("/v1/arm").is_success, "processes that may arm")
    later = daemon.call("POST", "/v1/plans", json=long_train(seconds=0.2))  # behind what would be left
    assert daemon.finished(later["plan"])["status"] == "done"
    assert len(board.of("pulse")) == pulses + later["planned"]  # nothing from before is lit after the next arming
