"""Local processes of a Dask cluster: the loop that starts them, a watch over them, and their end at once."""

import atexit
import os
import signal
import threading
import time
from contextlib import suppress
from multiprocessing import resource_tracker
from types import TracebackType
from typing import Any, Self

from optodrive.core.processes import is_suspended, list_children

LOOK_PERIOD_S = 0.2
SUSPENDED_MAX_S = 1.5
"""A worker that a signal has stopped for this time is killed; its task then runs again elsewhere."""


class LocalWorkers:
    """Watch over the processes that this process starts within the block.

    loop: of the cluster to be; its thread starts the processes, which inherit its signal mask
    has_started: to be set once all processes serve; if one ends before, the others are killed, for Dask would wait

    An exception in the block kills them at once: Dask's own end of a cluster takes up to half a minute.
    """

    def __init__(self) -> None:
        from distributed.utils import LoopRunner

        self.has_started = False
        self._before = list_children()
        self._runner: Any = LoopRunner()
        self._runner.start()
        self.loop: Any = self._runner.loop
        self._ending = threading.Event()
        self._watch = threading.Thread(target=self._kill_useless, name="workers", daemon=True)
        self._watch.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._watch.join()
        if kind is not None:
            self._abandon()
        else:
            self._runner.stop()

    def _list_workers(self) -> set[int]:
        tracker = getattr(resource_tracker, "_resource_tracker", None)
        return list_children() - self._before - {getattr(tracker, "_pid", None)}

    def _abandon(self) -> None:
        """Stop the loop, which would replace the workers, and kill them."""
        from distributed.deploy import spec

        atexit.unregister(spec.close_clusters)  # it would wait for a loop that no longer runs
        self.loop.add_callback(self.loop.stop)
        for pid in self._list_workers():
            _kill(pid)

    def _kill_useless(self) -> None:
        """Kill workers that a signal has stopped: they would never end their tasks, and Dask waits for minutes."""
        ran_s: dict[int, float] = {}
        looked_s, seen = time.monotonic(), set[int]()
        while not self._ending.wait(LOOK_PERIOD_S):
            now_s = time.monotonic()
            if now_s - looked_s > SUSPENDED_MAX_S:
                ran_s.clear()  # this process was suspended itself, as by Ctrl-Z
            looked_s = now_s
            workers = self._list_workers()
            is_incomplete, seen = not self.has_started and not seen <= workers, workers
            for pid in workers:
                if is_incomplete:
                    _kill(pid)
                elif not is_suspended(pid):
                    ran_s[pid] = now_s
                elif now_s - ran_s.setdefault(pid, now_s) > SUSPENDED_MAX_S:
                    _kill(pid)


def _kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
