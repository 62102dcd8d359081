"""An event loop in a thread of its own, whose coroutines callers in other threads wait for.

A blocking stream or hold is an asynchronous one in such a thread. So one thread alone enters the OpenSSL of a
connection, which forbids concurrent calls: a WebSocket that one thread reads while another sends now and then loses a
handshake or a message.
"""

import asyncio
from collections.abc import Coroutine
from concurrent.futures import CancelledError
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread
from typing import Any, Generic, TypeVar

from optodrive.client.exchange import run_blocking

T = TypeVar("T")
END_MAX_S = 1.0


class LoopThread:
    """An event loop in a thread."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the loop, and return its result. After `close`, one that waits for nothing."""
        if self._loop.is_closed():
            return run_blocking(coroutine)
        call = _Call(coroutine)
        try:
            self._loop.call_soon_threadsafe(call.start)
            answer = call.answers.get()
        except BaseException:  # of the caller's thread, such as KeyboardInterrupt
            with suppress(RuntimeError):  # another thread has closed the loop
                self._loop.call_soon_threadsafe(call.cancel)
            raise
        if isinstance(answer, BaseException):
            raise answer
        return answer[0]

    def close(self) -> None:
        """End the loop once the coroutines of other callers have ended."""
        if not self._loop.is_closed():
            self.run(_end_others())
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()


class _Call(Generic[T]):
    """A coroutine that a loop runs for a caller in another thread.

    Ctrl-C may interrupt that thread anywhere. It therefore takes no lock that is written in Python, as that of a
    concurrent.futures.Future is: an interruption would leave it taken. Nor does it free a task, because asyncio is told
    of that by a callback, which would drop the exception.

    answers: of one entry, the result as a tuple or the exception
    """

    def __init__(self, coroutine: Coroutine[Any, Any, T]) -> None:
        self.answers: SimpleQueue[tuple[T] | BaseException] = SimpleQueue()
        self._coroutine = coroutine
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start the coroutine, in the thread of the loop."""
        self._task = asyncio.get_running_loop().create_task(self._run())

    def cancel(self) -> None:
        """Cancel the coroutine, in the thread of the loop, if it has not ended."""
        if self._task is not None:
            self._task.cancel()
        else:
            self._coroutine.close()

    async def _run(self) -> None:
        answer: tuple[T] | BaseException
        try:
            answer = (await self._coroutine,)
        except asyncio.CancelledError:
            answer = CancelledError()
        except BaseException as error:  # of any kind, for the caller
            answer = error
        self._task = None
        self.answers.put(answer)


async def _end_others() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    if others:
        _, left = await asyncio.wait(others, timeout=END_MAX_S)
        for task in left:
            task.cancel()
