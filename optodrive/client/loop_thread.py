"""An event loop in a thread of its own, whose coroutines callers in other threads wait for.

A blocking stream or hold is an asynchronous one in such a thread. So one thread alone enters the OpenSSL of a
connection, which forbids concurrent calls: a WebSocket that one thread reads while another sends now and then loses a
handshake or a message.
"""

import asyncio
from collections.abc import Coroutine
from threading import Thread
from typing import Any, TypeVar

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
        future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return future.result()
        except BaseException:  # of the caller's thread, such as KeyboardInterrupt
            future.cancel()
            raise

    def close(self) -> None:
        """End the loop once the coroutines of other callers have ended."""
        if not self._loop.is_closed():
            self.run(_end_others())
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()


async def _end_others() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    if others:
        _, left = await asyncio.wait(others, timeout=END_MAX_S)
        for task in left:
            task.cancel()
