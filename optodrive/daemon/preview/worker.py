"""Worker process of the preview process: a forked child that does one job at a time within limits.

A job that exceeds its processor time ends with its worker. Fresh workers have the priority of the preview process; dry
runs, and builds that take longer than usual, run after the other processes of the daemon, but not after all other
programs: those would starve them on a busy computer. They are the last job of their worker.
"""

import os
import resource
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from optodrive.core.child_process import describe_end, fork_child
from optodrive.core.errors import InputError, OptodriveError
from optodrive.core.ipc import Message, MessageDecoder, MessageSocket, encode_message
from optodrive.daemon.preview.jobs import build_refusal

CPU_S = {"build": 5, "dry_run": 60}
"""Longest processor time of a job, s."""
WALL_S = 90.0
"""Longest duration of a job, s, including the time for which the processor serves others."""
MEMORY_BYTES = {"build": 768_000_000, "dry_run": 1_500_000_000}
"""Memory that a job may allocate, bytes."""
DEMOTION = 10
"""Niceness of a slow job above that of the preview process."""
QUICK_S = 0.1
"""Longest processor time of a usual build, s."""
CHECK_MIN_S = 0.005
CPU_CLOCK = 2
"""CPUCLOCK_SCHED of Linux: the processor time of a process, by the scheduler."""
JOBS_MAX = 200
"""Jobs after which a worker is replaced."""
LARGE_BYTES = 1_000_000
"""A worker is replaced after a job of this size, because it keeps the memory."""
JobRunner = Callable[[Message], Message]


def build_timeout_error(kind: str) -> InputError:
    """Build the error of a job that took too long."""
    what = "a body that is built" if kind == "build" else "a sequence that is planned"
    expected = f"{what} within {CPU_S[kind]} s of processor time, or {WALL_S:g} s in all"
    return InputError("body", "a longer computation", expected, "too_slow")


def build_memory_error(kind: str) -> InputError:
    """Build the error of a job that took too much memory."""
    expected = f"a request that takes at most {MEMORY_BYTES[kind] // 1_000_000} MB"
    return InputError("body", "more memory", expected, "too_large")


class Worker:
    """Parent's side of one worker process.

    connection: to the worker; deadline_s: host time at which the current job must have ended
    """

    def __init__(self, run_job: JobRunner) -> None:
        """Fork the worker. The calling process must have no other threads."""
        parent_end, child_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.pid = fork_child(lambda: _serve(child_end, run_job), "opto-worker", [child_end.fileno()])
        child_end.close()
        self.connection = MessageSocket(parent_end)
        self.deadline_s = self._check_at_s = float("inf")
        self.is_reusable = True
        self._kind = "build"
        self._began_cpu_s = 0.0
        self._job_count = 0

    def begin(self, job: Message, now_s: float, is_heavy: bool) -> None:
        """Start the clock of a job that is being sent."""
        self._kind = job.kind
        self._job_count += 1
        self.is_reusable &= self._job_count < JOBS_MAX and len(job.payload) < LARGE_BYTES
        self.deadline_s, self._check_at_s = now_s + WALL_S, now_s + QUICK_S
        self._began_cpu_s = self._read_cpu_s()
        if is_heavy:
            self.demote()

    def finish(self) -> None:
        """Stop the clock."""
        self.deadline_s = self._check_at_s = float("inf")

    @property
    def next_check_s(self) -> float:
        """Host time at which `is_slow` or the deadline must be looked at next."""
        return min(self.deadline_s, self._check_at_s)

    def is_slow(self, now_s: float) -> bool:
        """Return whether the job has taken more processor time than usual: a busy computer makes none slow."""
        if now_s < self._check_at_s:
            return False
        rest_s = QUICK_S - (self._read_cpu_s() - self._began_cpu_s)
        self._check_at_s = now_s + max(rest_s, CHECK_MIN_S)
        return rest_s <= 0.0

    def _read_cpu_s(self) -> float:
        """Return the processor time of the process, of which the clock's number is made from its id."""
        with suppress(OSError):  # it has ended
            return time.clock_gettime((~self.pid << 3) | CPU_CLOCK)
        return 0.0

    def demote(self) -> None:
        """Lower the priority of the process, which ends with its job."""
        self.is_reusable = False
        self._check_at_s = float("inf")
        os.setpriority(os.PRIO_PROCESS, self.pid, os.getpriority(os.PRIO_PROCESS, 0) + DEMOTION)

    def kill(self) -> None:
        """Kill the process if it still runs."""
        os.kill(self.pid, signal.SIGKILL)  # the process is not reaped yet, so the id is its own

    def collect(self, waits: bool = False) -> OptodriveError | None:
        """Return the error of a job that ended with the process, or None while the process exists.

        Call it until the process has ended, and not again. On a busy computer a killed process of low priority may take
        seconds to end. waits: for the end.
        """
        pid, status = os.waitpid(self.pid, 0 if waits else os.WNOHANG)
        if pid == 0:
            return None
        if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU:
            return build_timeout_error(self._kind)
        if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGABRT:
            return build_memory_error(self._kind)  # by a compiled library
        return OptodriveError(f"the process that worked on the request: {describe_end(status)}")


def _serve(connection: socket.socket, run_job: JobRunner) -> int:
    """Serve jobs until the parent closes the connection. Return the exit status."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    base_bytes = _read_data_bytes()
    decoder = MessageDecoder()
    with suppress(OSError):  # the parent has closed it meanwhile, and no longer waits for the result
        while data := connection.recv(1 << 20):
            for job in decoder.feed(data):
                _limit(job.kind, base_bytes)
                connection.sendall(encode_message(_run_safely(run_job, job)))
    return 0


def _read_data_bytes() -> int:
    """Return the memory of the process that RLIMIT_DATA counts, bytes."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmData:")[2].split()[0])


def _limit(kind: str, base_bytes: int) -> None:
    """Limit the processor time and the memory of the next job."""
    cpu_s = int(time.process_time()) + CPU_S[kind] + 1
    for limit, value in ((resource.RLIMIT_CPU, cpu_s), (resource.RLIMIT_DATA, base_bytes + MEMORY_BYTES[kind])):
        _, hard = resource.getrlimit(limit)
        resource.setrlimit(limit, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


def _run_safely(run_job: JobRunner, job: Message) -> Message:
    try:
        return run_job(job)
    except MemoryError:
        return build_refusal(build_memory_error(job.kind))
    except Exception as error:
        return build_refusal(OptodriveError(f"{job.kind}: {type(error).__name__}: {error}"))
