"""A worker process for computations and disk access while the parent process renews the lease of an armed board.

A thread would share the interpreter's lock, which would delay the lease on a busy machine.
"""

import multiprocessing as mp
import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Self

from optodrive.core.errors import InputError, OptodriveError, RefusedError

NICE = 5


class WorkerProcess:
    """Runs one function at a time; it ends with its parent process, however that ends."""

    def __init__(self) -> None:
        context = mp.get_context("spawn")  # a fork would keep the board's port open after the parent ended
        self._pipe, child_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(child_end,), name="aside", daemon=True)
        self._process.start()
        child_end.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pipe.close()
        self._process.terminate()
        self._process.join()

    def submit(self, function: Callable[..., Any], *arguments: object) -> None:
        """Start a function of a module with its arguments."""
        try:
            self._pipe.send((function, arguments))
        except OSError:
            raise self._build_exit_error() from None

    def is_ready(self) -> bool:
        """Return whether the result is available."""
        return self._pipe.poll()

    def result(self) -> Any:
        """Wait for the result and return it.

        Raise RefusedError if the function raised InputError, OptodriveError for any other error.
        """
        try:
            outcome = self._pipe.recv()
        except (EOFError, OSError):
            raise self._build_exit_error() from None
        if isinstance(outcome, OptodriveError):
            raise outcome
        return outcome

    def _build_exit_error(self) -> OptodriveError:
        return OptodriveError("the worker process has ended: out of memory, or killed?")


def _serve(pipe: Connection) -> None:
    # A new session: Ctrl-C at the terminal then reaches only the parent, and Linux schedules the processor by session.
    os.setsid()
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
        pipe.send(outcome)
