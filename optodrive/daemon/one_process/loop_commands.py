"""Commands of other threads that the engine's loop executes."""

from collections.abc import Callable
from concurrent.futures import Future
from queue import Empty, SimpleQueue
from typing import TypeVar

from optodrive.core.errors import OptodriveError
from optodrive.daemon.one_process.state_waiters import uncancellable_future

T = TypeVar("T")


class LoopCommands:
    """Queue of commands. Any thread posts, the loop runs them."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[Callable[[], None]] = SimpleQueue()

    def post(self, command: Callable[[], None]) -> None:
        """Queue a command that handles its own errors."""
        self._queue.put(command)

    def submit(self, action: Callable[[], T]) -> "Future[T]":
        """Queue an action and return the future of its result."""
        future: Future[T] = uncancellable_future()

        def run_action() -> None:
            try:
                future.set_result(action())
            except OptodriveError as error:
                future.set_exception(error)

        self.post(run_action)
        return future

    def run_pending(self) -> None:
        """Run all queued commands."""
        while True:
            try:
                command = self._queue.get_nowait()
            except Empty:
                return
            command()
