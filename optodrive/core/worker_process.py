"""A worker process for computations and disk access, beside a parent that renews the lease of an armed board.

A thread would share the interpreter's lock, which would delay the lease on a busy machine.
"""

import multiprocessing as mp
import os
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Self

from optodrive.core.child_process import die_with_parent
from optodrive.core.errors import InputError, OptodriveError, RefusedError
from optodrive.core.processes import is_suspended

NICE = 5
LOOK_PERIOD_S = 0.1
SUSPENDED_MAX_S = 2.0
"""A worker that a signal has stopped for this time is given up."""


class WorkerLostError(OptodriveError):
    """The worker process has ended, or is suspended."""


class WorkerProcess:
    """Runs one function at a time. It ends with its parent process, however that ends."""

    def __init__(self) -> None:
        context = mp.get_context("spawn")  # a fork would keep the board's port open after the parent ended
        self._pipe, child_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(child_end,), name="aside", daemon=True)
        self._process.start()
        child_end.close()
        self._look_at_s = self._ran_s = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        self._pipe.close()
        self._process.kill()  # SIGTERM would wait in a worker that is suspended
        self._process.join()

    def fileno(self) -> int:
        """Return the descriptor that becomes readable with a result, or at the worker's end."""
        return self._pipe.fileno()

    def submit(self, function: Callable[..., Any], *arguments: object) -> None:
        """Start a function of a module with its arguments."""
        try:
            self._pipe.send((function, arguments))
        except OSError:
            raise self._build_exit_error() from None

    def is_ready(self) -> bool:
        """Return whether the result is available. Raise WorkerLostError if the worker is suspended."""
        if self._pipe.poll():
            return True
        self._check_runs()
        return False

    def result(self) -> Any:
        """Wait for the result and return it.

        Raise RefusedError if the function raised InputError, OptodriveError for any other error, WorkerLostError if the
        worker has ended or is suspended.
        """
        try:
            while not self._pipe.poll(LOOK_PERIOD_S):
                self._check_runs()
            outcome = self._pipe.recv()
        except (EOFError, OSError):
            raise self._build_exit_error() from None
        if isinstance(outcome, OptodriveError):
            raise outcome
        return outcome

    def _check_runs(self) -> None:
        """Raise WorkerLostError if a signal has stopped the worker, which then would not end its computation."""
        now_s = time.monotonic()
        if now_s < self._look_at_s:
            return
        if now_s > self._look_at_s + SUSPENDED_MAX_S:
            self._ran_s = now_s  # this process was suspended itself
        self._look_at_s = now_s + LOOK_PERIOD_S
        if not is_suspended(self._process.pid):
            self._ran_s = now_s
        elif now_s - self._ran_s > SUSPENDED_MAX_S:
            raise WorkerLostError(f"the worker process {self._process.pid} is suspended: stopped by a signal")

    def _build_exit_error(self) -> WorkerLostError:
        return WorkerLostError("the worker process has ended: out of memory, or killed?")


def _serve(pipe: Connection) -> None:
    # A new session: Ctrl-C at the terminal then reaches only the parent, and Linux schedules the processor by session.
    os.setsid()
    die_with_parent()
    os.setpriority(os.PRIO_PROCESS, 0, NICE)
    while True:
        try:
            function, arguments = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            outcome = function(*arguments)
        except InputError as error:
            outcome = RefusedError(str(error))
        except Exception as error:
            outcome = OptodriveError(f"{function.__name__}: {type(error).__name__}: {error}")
        with suppress(OSError):  # the parent has ended, which the next recv() shows
            pipe.send(outcome)
