"""Who armed, disarmed, stopped and pushed what, and when: lines of JSON, only ever added to a file.

Written by a thread of its own, so that a slow disk holds nothing up. Arming waits for its line to be on the disk and
is refused without it; nothing else is, least of all STOP.
"""

import asyncio
import json
import os
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from threading import Semaphore

WAITING_MAX = 1000
PATIENCE_S = 2.0
Facts = Mapping[str, object]


class Audit:
    """The file. say: gets a line when it cannot be written, and when it can again; now: wall clock, UTC."""

    def __init__(
        self,
        path: Path,
        say: Callable[[str], None],
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._path = path
        self._say = say
        self._now = now
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="audit")
        self._room = Semaphore(WAITING_MAX)
        self._torn = False
        self._failed = False

    def note(self, facts: Facts) -> None:
        """Add a line soon; not where a thousand wait already."""
        if self._room.acquire(blocking=False):
            self._queue(facts, to_disk=False)

    async def must(self, facts: Facts) -> str | None:
        """Add a line and wait until it is on the disk; what went wrong where it is not."""
        if not self._room.acquire(blocking=False):
            return "too many lines wait to be written"
        try:
            await asyncio.wait_for(asyncio.wrap_future(self._queue(facts, to_disk=True)), PATIENCE_S)
        except OSError as error:  # a TimeoutError is one
            return error.strerror or f"not written within {PATIENCE_S:g} s"
        return None

    def _queue(self, facts: Facts, to_disk: bool) -> "Future[None]":
        line = json.dumps({"at": self._now().isoformat(timespec="milliseconds"), **facts})
        future = self._writer.submit(self._write, line, to_disk)
        future.add_done_callback(lambda _: self._room.release())
        return future

    def _write(self, line: str, to_disk: bool) -> None:
        try:
            self._append(("\n" if self._torn else "") + line + "\n", to_disk)
        except OSError as error:
            if not self._failed:
                self._say(f"audit: {self._path} cannot be written ({error.strerror}); arming is refused until it can")
            self._failed = True
            raise
        if self._failed:
            self._say(f"audit: {self._path} is written again")
        self._failed = self._torn = False

    def _append(self, text: str, to_disk: bool) -> None:
        # Opened for each line: a file that was moved away is begun anew, and a lost disk is noticed.
        handle = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            data = text.encode("ascii")
            written = os.write(handle, data)
            if written < len(data):
                self._torn = True
                os.write(handle, data[written:])  # says why
                self._torn = False
            if to_disk:
                os.fsync(handle)
        finally:
            os.close(handle)

    def close(self) -> None:
        """Write what waits, if that does not take long."""
        last = self._writer.submit(lambda: None)
        try:
            last.result(PATIENCE_S)
        except TimeoutError:
            self._say(f"audit: {self._path} takes too long; its last lines may be missing")
        self._writer.shutdown(wait=False, cancel_futures=True)
