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

QUEUE_MAX = 1000
WRITE_TIMEOUT_S = 2.0
AuditFields = Mapping[str, object]


class AuditLog:
    """The file. say: gets a line when it cannot be written, and when it can again; now: wall clock, UTC."""

    def __init__(
        self,
        path: Path,
        report: Callable[[str], None],
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._path = path
        self._report = report
        self._now = now
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="audit")
        self._free_slots = Semaphore(QUEUE_MAX)
        self._has_partial_line = False
        self._is_failing = False

    def record(self, fields: AuditFields) -> None:
        """Add a line soon; not where a thousand wait already."""
        if self._free_slots.acquire(blocking=False):
            self._enqueue(fields, to_disk=False)

    async def record_durably(self, fields: AuditFields) -> str | None:
        """Add a line and wait until it is on the disk; what went wrong where it is not."""
        if not self._free_slots.acquire(blocking=False):
            return "too many lines wait to be written"
        try:
            await asyncio.wait_for(asyncio.wrap_future(self._enqueue(fields, to_disk=True)), WRITE_TIMEOUT_S)
        except OSError as error:  # a TimeoutError is one
            return error.strerror or f"not written within {WRITE_TIMEOUT_S:g} s"
        return None

    def _enqueue(self, fields: AuditFields, to_disk: bool) -> "Future[None]":
        line = json.dumps({"at": self._now().isoformat(timespec="milliseconds"), **fields})
        future = self._writer.submit(self._write, line, to_disk)
        future.add_done_callback(lambda _: self._free_slots.release())
        return future

    def _write(self, line: str, to_disk: bool) -> None:
        try:
            self._append(("\n" if self._has_partial_line else "") + line + "\n", to_disk)
        except OSError as error:
            if not self._is_failing:
                self._report(
                    f"audit: {self._path} cannot be written ({error.strerror}); arming is refused until it can"
                )
            self._is_failing = True
            raise
        if self._is_failing:
            self._report(f"audit: {self._path} is written again")
        self._is_failing = self._has_partial_line = False

    def _append(self, text: str, to_disk: bool) -> None:
        # Opened for each line: a file that was moved away is begun anew, and a lost disk is noticed.
        handle = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            data = text.encode("ascii")
            written = os.write(handle, data)
            if written < len(data):
                self._has_partial_line = True
                os.write(handle, data[written:])  # says why
                self._has_partial_line = False
            if to_disk:
                os.fsync(handle)
        finally:
            os.close(handle)

    def close(self) -> None:
        """Write what waits, if that does not take long."""
        last = self._writer.submit(lambda: None)
        try:
            last.result(WRITE_TIMEOUT_S)
        except TimeoutError:
            self._report(f"audit: {self._path} takes too long; its last lines may be missing")
        self._writer.shutdown(wait=False, cancel_futures=True)
