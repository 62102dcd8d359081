"""Commands of other threads that the engine's loop executes."""

import os
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from optodrive.core.errors import OptodriveError

T = TypeVar("T")


def uncancellable_future() -> "Future[Any]":
    """Return a future that its consumers cannot cancel.

    A consumer that gives up must not cancel the engine's pending operation.
    """
    future: Future[Any] = Future()
    future.set_running_or_notify_cancel()
    return future


class LoopCommands:
    """Queue of commands. Any thread posts, the loop runs them."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        """Return the descriptor that is readable while commands may wait."""
        return self._event

    def post(self, command: Callable[[], None]) -> None:
        """Queue a command that handles its own errors. Do nothing after close()."""
        self._queue.put(command)
        with suppress(OSError):
            os.eventfd_write(self._event, 1)

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
        with suppress(BlockingIOError):
            os.eventfd_read(self._event)
        while True:
            try:
                command = self._queue.get_nowait()
            except Empty:
                return
            command()

    def close(self) -> None:
        """Close the descriptor. Commands that are posted later never run."""
        event, self._event = self._event, -1
        os.close(event)
