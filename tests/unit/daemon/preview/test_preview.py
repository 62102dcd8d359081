"""Preview process: each job ends within its limits with one clear line, and the next one runs."""

import json
import multiprocessing as mp
import os
import pickle
import signal
import socket
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import pytest

from displays import DISPLAYS
from optodrive.core.child_process import BeatWriter
from optodrive.core.errors import BusyError
from optodrive.core.ipc import Message, MessageSocket
from optodrive.daemon import push
from optodrive.daemon.engine.active_plan import ThermalEstimate
from optodrive.daemon.engine.plan_making import DryRunStart
from optodrive.daemon.preview import jobs, worker
from optodrive.daemon.preview.jobs import CALLER_WAITING_MAX, WAITING_MAX, Job, JobQueue
from optodrive.daemon.preview.process import run_preview
from optodrive.daemon.push import Push
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.runtime_folder import open_runtime_folder
from optodrive.daemon.supervisor.daemon import NICE
from optodrive.planning.pipeline import warm_up
from optodrive.planning.stimuli.sequence_file import decode_sequence

DISPLAY = DISPLAYS["display-16"]
FRAME = {"show_at_s": 0, "duration_s": 1, "target_um": {"5": 60}}
SMALL = json.dumps({"frames": [FRAME]}).encode()
NO_LIMIT_S = 1_000_000
"""Duration of a job that no test reaches."""


def wait_for(condition):
    while not condition():
        time.sleep(0.005)


def lift_limits(monkeypatch, kind):
    monkeypatch.setitem(worker.CPU_S, kind, NO_LIMIT_S)
    monkeypatch.setattr(worker, "WALL_S", NO_LIMIT_S)


class Preview:
    """A preview process and one connection to it."""

    def __init__(self):
        self.folder = open_runtime_folder(0, None)
        self.supervisor, child_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.process = mp.get_context("fork").Process(target=self._run, args=(child_end,))
        self.process.start()
        child_end.close()
        while b"ready" not in self.supervisor.recv(1000):
            pass
        self.socket = self.connect()

    def _run(self, child_end):
        self.supervisor.close()
        run_preview(DISPLAY, self.folder, BeatWriter(child_end.detach()))

    def connect(self):
        return MessageSocket.connect(self.folder.preview_socket)

    def send(self, kind, job_id, payload=b"", **fields):
        self.socket.send(Message(kind, {"id": job_id, **fields}, payload))

    def build(self, job_id, body, source="sequence", name="push", caller=""):
        self.send("build", job_id, body, source=source, push=Push(name, {}, 0.0, 0, caller)._asdict())

    def dry_run(self, job_id, body, caller=""):
        start = pickle.dumps(DryRunStart(ThermalEstimate(*DISPLAY.build_cold_state()), 0.05))
        push = Push("push", {}, 0.0, 0, caller)._asdict()
        self.send("dry_run", job_id, start + body, source="sequence", push=push, snapshot_bytes=len(start))

    def results(self, count):
        """Wait for results and return them by id."""
        found = {}
        while len(found) < count:
            self.socket.flush()
            for message in self.socket.receive():
                found[message.fields["id"]] = message
            time.sleep(0.002)
        return found

    def result(self):
        (message,) = self.results(1).values()
        return message

    def workers(self):
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text()
        return {int(pid) for pid in children.split()}

    def slow_workers(self):
        """Return the workers of low priority."""
        found = set()
        for pid in self.workers():
            with suppress(ProcessLookupError):  # it has ended meanwhile
                if os.getpriority(os.PRIO_PROCESS, pid) > os.getpriority(os.PRIO_PROCESS, self.process.pid):
                    found.add(pid)
        return found

    def stop(self):
        self.socket.close()
        self.supervisor.close()
        self.process.join()
        assert self.process.exitcode in (0, -signal.SIGKILL)
        self.folder.remove()


@pytest.fixture
def preview(start):
    return start()


def problem(message):
    return message.fields["status"], json.loads(message.payload)


def assert_serves(preview):
    preview.build(99, SMALL)
    message = preview.result()
    assert message.fields == {"id": 99, "status": 200, "labels": {}, "parameters": {}}
    (frame,) = decode_sequence(message.payload).frames
    assert frame.target_m[5] == pytest.approx(60e-6)


def test_sequences_and_patterns_are_built_and_errors_are_problems(preview):
    assert_serves(preview)
    preview.build(1, b'{"pixel": 3, "height_um": 40}', "pattern", "pixel")
    assert decode_sequence(preview.result().payload).frames[0].target_m[3] == pytest.approx(40e-6)
    preview.build(2, b"", "pattern", "pixel")
    assert preview.result().fields["status"] == 200
    for body, source, name, status, code in (
        (b"{", "sequence", "push", 422, "bad_json"),
        (b"[]", "pattern", "pixel", 422, "bad_input"),
        (b"{}", "pattern", "pixle", 404, "unknown_pattern"),
    ):
        preview.build(3, body, source, name)
        found, document = problem(preview.result())
        assert (found, document["code"]) == (status, code)


def test_a_dry_run_is_planned_from_its_snapshot_and_is_not_stored(preview):
    preview.dry_run(7, SMALL)
    message = preview.result()
    report = PlanReport.model_validate_json(message.payload)
    assert (message.fields["status"], report.plan, report.status, report.planned) == (200, "dry-run", "planned", 1)
    assert report.starts_in_s == 0.05
    assert message.fields["audit"] == {"plan": "dry-run", "pattern": "push", "pulses": 1, "plan_status": "planned"}


@pytest.mark.parametrize(
    "body",
    [
        b"{" + b",".join([b'"aaaaaaaaaaaa":0'] * 500_000) + b"}",
        b"{" + b",".join(b'"%012d":0' % k for k in [*range(499_999), 499_998]) + b"}",
    ],
    ids=["one key", "one of many keys"],
)
def test_a_body_that_repeats_a_key_is_refused_in_one_line(start, monkeypatch, body):
    """A search that compared each key with each other one would not end."""
    lift_limits(monkeypatch, "build")
    assert len(body) > 7_900_000
    preview = start()
    preview.build(1, body)
    status, document = problem(preview.result())
    assert (status, document["code"]) == (422, "bad_json")
    assert "each key of an object once" in document["detail"]
    assert "\n" not in document["detail"]
    assert_serves(preview)


def build_slowly(*_):
    while True:
        sum(range(1000))


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Return a function that starts a preview process.

    act: called to build the body b"bad"
    """
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    warm_up(DISPLAY)
    started, parse = [], push.parse_request

    def start_preview(act=build_slowly):
        monkeypatch.setattr(push, "parse_request", lambda body, *more: act() if body == b"bad" else parse(body, *more))
        started.append(Preview())
        return started[-1]

    yield start_preview
    for preview in started:
        preview.stop()


def test_a_slow_job_runs_after_the_daemon_but_not_after_all_other_programs():
    assert NICE < NICE + worker.DEMOTION <= 0


@pytest.mark.parametrize("kind", ["build", "dry_run"])
def test_others_are_built_while_a_job_is_slow(start, monkeypatch, kind):
    lift_limits(monkeypatch, kind)
    monkeypatch.setattr(jobs, "make_plan", build_slowly)
    preview = start()
    preview.build(1, b"bad") if kind == "build" else preview.dry_run(1, SMALL)
    for _ in range(3):
        assert_serves(preview)


def test_a_body_that_is_built_too_slowly_ends_at_its_limit(start, monkeypatch):
    monkeypatch.setitem(worker.CPU_S, "build", 1)
    preview = start()
    preview.build(1, b"bad")
    status, document = problem(preview.result())
    assert (status, document["code"]) == (422, "too_slow")
    assert "expected a body that is built within 1 s of processor time, or 90 s in all" in document["detail"]
    assert_serves(preview)


def test_a_job_that_the_processor_does_not_serve_ends_at_its_limit(start, monkeypatch):
    monkeypatch.setattr(worker, "WALL_S", 0.5)
    monkeypatch.setattr(jobs, "make_plan", lambda *_: time.sleep(3600.0))
    preview = start()
    preview.dry_run(1, SMALL)
    status, document = problem(preview.result())
    assert (status, document["code"]) == (422, "too_slow")
    assert "a sequence that is planned within 60 s of processor time, or 0.5 s in all" in document["detail"]
    assert_serves(preview)


def test_a_job_that_takes_too_much_memory_is_refused(start):
    preview = start(lambda: bytearray(2_000_000_000))
    preview.build(1, b"bad")
    status, document = problem(preview.result())
    assert (status, document["code"]) == (422, "too_large")
    assert "at most 768 MB" in document["detail"]
    assert_serves(preview)


def test_a_worker_that_crashes_costs_only_its_job(start):
    preview = start(lambda: os.kill(os.getpid(), signal.SIGSEGV))
    preview.build(1, b"bad")
    status, document = problem(preview.result())
    assert status == 500
    assert document["detail"] == "the process that worked on the request: killed by SIGSEGV"
    assert_serves(preview)


def test_the_work_of_a_caller_that_left_ends_at_once(start, monkeypatch):
    lift_limits(monkeypatch, "dry_run")
    monkeypatch.setattr(jobs, "make_plan", build_slowly)
    preview = start()
    for job_id in range(3):  # one runs, two wait
        preview.dry_run(job_id, SMALL)
    wait_for(preview.slow_workers)
    first = preview.slow_workers()
    assert_serves(preview)
    preview.send("drop", 1)
    preview.send("drop", 0)
    wait_for(lambda: preview.slow_workers() and not preview.slow_workers() & first)  # the last one runs
    left, preview.socket = preview.socket, preview.connect()
    left.close()
    wait_for(lambda: not preview.slow_workers())
    assert_serves(preview)


@pytest.mark.parametrize("kind", ["build", "dry_run"])
def test_the_work_of_one_caller_delays_no_other_callers(start, monkeypatch, kind):
    """In order: of the work that never ends nothing has been answered when the other callers have their results."""
    lift_limits(monkeypatch, kind)
    monkeypatch.setattr(jobs, "make_plan", build_slowly)
    preview = start()
    for job_id in range(4):
        if kind == "build":
            preview.build(job_id, b"bad", caller="one")
        else:
            preview.dry_run(job_id, SMALL, caller="one")
    for job_id in range(10, 15):
        preview.build(job_id, SMALL, caller="two")
        assert preview.result().fields["id"] == job_id
        assert len(preview.slow_workers()) <= 1, "one of a caller, also of builds that turned out to be slow"
    preview.build(20, b"bad", caller="three")
    wait_for(lambda: len(preview.slow_workers()) == 2)
    assert_serves(preview)


def test_a_build_that_was_ended_for_others_is_built_in_its_turn(start, monkeypatch):
    lift_limits(monkeypatch, "build")
    begun = [mp.get_context("fork").RawValue("i", 0) for _ in range(3)]

    def end_at_the_third_time():
        number = next(k for k, pid in enumerate(begun) if pid.value == 0)
        begun[number].value = os.getpid()
        return ({}, {}) if number == 2 else build_slowly()

    preview = start(end_at_the_third_time)
    preview.build(1, b"bad", caller="one")
    wait_for(preview.slow_workers)
    preview.build(2, b"bad", caller="one")
    wait_for(lambda: begun[1].value and begun[1].value not in preview.workers())
    preview.send("drop", 1)
    assert problem(preview.result())[0] == 500  # what it returned is no sequence
    assert begun[2].value
    assert_serves(preview)


def test_a_library_that_gives_up_for_want_of_memory_is_one_line(start):
    preview = start(os.abort)
    preview.build(1, b"bad")
    status, document = problem(preview.result())
    assert (status, document["code"]) == (422, "too_large")


@pytest.mark.parametrize("kind", ["build", "dry_run"])
@pytest.mark.parametrize("callers", [3, 4, 8])
def test_light_builds_pass_all_heavy_callers(start, monkeypatch, callers, kind):
    """In order: of work that never ends nothing is answered but for want of room, and a further caller is served."""
    lift_limits(monkeypatch, kind)
    monkeypatch.setattr(jobs, "make_plan", build_slowly)
    preview = start()
    heavy = preview.socket
    for job_id in range(callers * CALLER_WAITING_MAX):
        if kind == "build":
            preview.build(job_id, b"bad", caller=f"heavy {job_id % callers}")
        else:
            preview.dry_run(job_id, SMALL, caller=f"heavy {job_id % callers}")
    heavy.flush()
    preview.socket = preview.connect()
    for job_id in range(100, 104):
        preview.build(job_id, SMALL, caller="light")
        message = preview.result()
        assert (message.fields["id"], message.fields["status"]) == (job_id, 200)
    refused = list(heavy.receive())
    assert {message.fields["status"] for message in refused} <= {503}
    assert {message.fields["id"] % callers for message in refused} in (set(), set(range(callers))), "from all alike"
    heavy.close()


@pytest.mark.parametrize("callers", [3, 4, 8])
def test_callers_take_turns(callers):
    """A caller that came first with many jobs gets one turn for one of each other caller."""
    queue = JobQueue()
    for number in range(CALLER_WAITING_MAX):
        queue.add(_job("first", number))
    for caller in range(1, callers):
        for number in range(2):
            queue.add(_job(f"caller {caller}", number))
    order = [queue.take(lambda job: True, set()).caller for _ in range(2 * callers)]
    turn = ["first", *(f"caller {k}" for k in range(1, callers))]
    assert order == [*turn, *turn]


@pytest.mark.parametrize("callers", [2, 4, 5, WAITING_MAX["build"]])
def test_a_full_queue_is_shared_evenly(callers):
    queue, left = JobQueue(), []
    for number in range(CALLER_WAITING_MAX):
        for caller in range(callers):
            with suppress(BusyError):
                left.append(queue.add(_job(f"caller {caller}", number)))
    waiting = Counter(job.caller for job in queue._jobs)
    assert sum(waiting.values()) == min(WAITING_MAX["build"], callers * CALLER_WAITING_MAX)
    assert len(waiting) == callers
    assert max(waiting.values()) - min(waiting.values()) <= 1
    if callers < WAITING_MAX["build"]:
        displaced = queue.add(_job("late", 0))
        assert (displaced is None) == (callers * CALLER_WAITING_MAX < WAITING_MAX["build"])
        assert displaced is None or waiting[displaced.caller] == max(waiting.values())
    else:
        with pytest.raises(BusyError, match="too many requests wait: 16 before this one"):
            queue.add(_job("late", 0))


def test_a_caller_with_many_waiting_jobs_is_refused():
    queue = JobQueue()
    for number in range(CALLER_WAITING_MAX):
        assert queue.add(_job("one", number)) is None
    with pytest.raises(BusyError, match=f"too many requests wait: {CALLER_WAITING_MAX} before this one"):
        queue.add(_job("one", 9))
    assert queue.add(_job("another", 0)) is None


def _job(caller, number):
    return Job(None, Message("build", {"id": number, "push": {"caller": caller}}, b""))


def test_the_queue_is_bounded_for_each_kind_and_each_caller(start, monkeypatch):
    lift_limits(monkeypatch, "build")
    monkeypatch.setattr(worker, "QUICK_S", NO_LIMIT_S)
    preview = start()
    for job_id in range(20):
        preview.build(job_id, b"bad", caller=f"caller {job_id % 16}")
    refused = preview.results(2)
    for message in refused.values():
        status, document = problem(message)
        assert (status, document["code"]) == (503, "busy")
        assert "too many requests wait" in document["detail"]
    assert set(refused) == {18, 19}
    before = preview.workers()
    for job_id in range(18):
        preview.send("drop", job_id)
    wait_for(lambda: len(before & preview.workers()) == 1)  # the spare one; the others have ended
    for job_id in range(20, 27):
        preview.build(job_id, b"bad", caller="one")
    assert set(preview.results(1)) == {26}  # two run, four of the caller wait


def test_the_workers_end_with_the_preview_process(preview):
    (spare,) = preview.workers()
    preview.process.kill()
    preview.process.join()
    status = Path(f"/proc/{spare}/status")
    wait_for(lambda: not status.exists() or "State:\tZ" in status.read_text())
