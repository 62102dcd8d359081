"""Work in a process of its own: whoever holds an armed board renews its lease while numbers and disks take their time.

A thread would share the interpreter's lock, and on a busy machine the lease would wait for it.
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
    """Does one thing at a time; ends with whoever started it, however that ends."""

    def __init__(self) -> None:
        context = mp.get_context("spawn")  # a fork would keep the board's port open after its holder has gone
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
        """Hand over a function of a module, and what it takes."""
        try:
            self._pipe.send((function, arguments))
        except OSError:
            raise self._build_exit_error() from None

    def is_ready(self) -> bool:
        """Whether it is done."""
        return self._pipe.poll()

    def result(self) -> Any:
        """What came of it; waits for it. RefusedError where its input was wrong, OptodriveError where it failed."""
        try:
            outcome = self._pipe.recv()
        except (EOFError, OSError):
            raise self._build_exit_error() from None
        if isinstance(outcome, OptodriveError):
            raise outcome
        return outcome

    def _build_exit_error(self) -> OptodriveError:
        return OptodriveError("the process that fits has ended: out of memory, or ended from outside?")


def _serve(pipe: Connection) -> None:
    # A session of its own: a Ctrl-C at the terminal is for the holder, and so is its share of the processor, which
    # Linux deals out by sessions.
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
