"""The audit log: one line of JSON per refused request and per request that is not a read, appended to a file.

A separate thread writes it, so that a slow disk delays nothing, not even the end of the process. Only arming waits
until its entry is on the disk, and is refused if the entry cannot be written; STOP never waits. Entries of refused
requests are bounded per kind, so that a flood of them fills no disk.
"""

import asyncio
import json
import os
import stat
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from queue import SimpleQueue
from threading import Semaphore, Thread
from typing import NamedTuple

QUEUE_MAX = 1000
LINE_MAX_BYTES = 1_000_000
"""Longest incomplete line that is completed, bytes; an entry is much shorter."""
WRITE_TIMEOUT_S = 2.0
AuditFields = Mapping[str, object]


class _Entry(NamedTuple):
    line: str
    to_disk: bool
    future: "Future[None]"


class AuditLog:
    """An audit log.

    report: receives a message when the file cannot be written, and when it can again; now: wall clock, UTC
    """

    def __init__(
        self,
        path: Path,
        report: Callable[[str], None],
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._path = path
        self._report = report
        self._now = now
        self._queue: SimpleQueue[_Entry | None] = SimpleQueue()
        self._may_be_torn = True  # by an earlier process, on a disk that was full or lost its power
        # A daemon thread: one that hangs in a write must not keep the process from ending.
        self._writer = Thread(target=self._run, name="audit", daemon=True)
        self._writer.start()
        self._free_slots = Semaphore(QUEUE_MAX)
        self._is_failing = False

    def record(self, fields: AuditFields) -> None:
        """Append an entry later. Drop it if a thousand wait already."""
        if self._free_slots.acquire(blocking=False):
            self._enqueue(fields, to_disk=False)

    async def record_durably(self, fields: AuditFields) -> str | None:
        """Append an entry and wait until it is on the disk. Return the cause if that fails, else None."""
        if not self._free_slots.acquire(blocking=False):
            return "too many entries wait to be written"
        try:
            await asyncio.wait_for(asyncio.wrap_future(self._enqueue(fields, to_disk=True)), WRITE_TIMEOUT_S)
        except OSError as error:  # a TimeoutError is one
            return error.strerror or f"not written within {WRITE_TIMEOUT_S:g} s"
        return None

    def _enqueue(self, fields: AuditFields, to_disk: bool) -> "Future[None]":
        line = json.dumps({"at": self._now().isoformat(timespec="milliseconds"), **fields})
        entry = _Entry(line, to_disk, Future())
        self._queue.put(entry)
        return entry.future

    def _run(self) -> None:
        with suppress(OSError):  # the first entry reports it
            self._complete_last_line()
        while (entry := self._queue.get()) is not None:
            try:
                self._write(entry.line, entry.to_disk)
                error = None
            except OSError as caught:
                error = caught
            # Before the future: a caller that waits for it may record again at once.
            self._free_slots.release()
            # False where the caller has given up after WRITE_TIMEOUT_S.
            if entry.future.set_running_or_notify_cancel():
                entry.future.set_result(None) if error is None else entry.future.set_exception(error)

    def _write(self, line: str, to_disk: bool) -> None:
        try:
            self._append(line + "\n", to_disk)
        except OSError as error:
            if not self._is_failing:
                self._report(
                    f"audit: {self._path} cannot be written ({error.strerror}); arming is refused until it can"
                )
            self._is_failing = True
            raise
        if self._is_failing:
            self._report(f"audit: {self._path} is writable again")
        self._is_failing = False

    def _complete_last_line(self) -> None:
        """Replace a last line that was cut off by an entry that quotes it, so that every line of the file is JSON."""
        if self._may_be_torn and self._path.exists() and stat.S_ISREG(self._path.stat().st_mode):
            with self._path.open("r+b", buffering=0) as file:
                size = file.seek(0, os.SEEK_END)
                # From the end alone: the file may have gigabytes.
                file.seek(max(0, size - LINE_MAX_BYTES))
                torn = file.read(LINE_MAX_BYTES).rpartition(b"\n")[2]
                if torn:
                    quoted = {"event": "incomplete", "line": torn.decode("ascii", "backslashreplace")}
                    entry = json.dumps({"at": self._now().isoformat(timespec="milliseconds"), **quoted}) + "\n"
                    file.seek(size - len(torn))
                    try:
                        written = file.write(entry.encode("ascii"))
                        if written < len(entry):
                            file.write(entry[written:].encode("ascii"))  # raises the cause
                    except OSError:  # no room: nothing of the old line may be lost
                        file.truncate(size)
                        file.seek(size - len(torn))
                        file.write(torn)
                        raise
        self._may_be_torn = False

    def _append(self, text: str, to_disk: bool) -> None:
        self._complete_last_line()
        # Opened for each entry: a file that was moved away is created anew, and a lost disk is detected.
        # Non-blocking: a pipe without a reader is an error, not a wait.
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK
        handle = os.open(self._path, flags, 0o600)
        try:
            data = text.encode("ascii")
            written = os.write(handle, data)
            if written < len(data):
                self._may_be_torn = True
                os.write(handle, data[written:])  # raises the cause
                self._may_be_torn = False
            if to_disk:
                os.fsync(handle)
        finally:
            os.close(handle)

    def close(self) -> None:
        """Write the waiting entries, for at most two seconds."""
        self._queue.put(None)
        self._writer.join(WRITE_TIMEOUT_S)
        if self._writer.is_alive():
            self._report(f"audit: {self._path} is slow; its last entries may be missing")


PERIOD_S = 60.0
ENTRIES_MAX = 60
"""At most ENTRIES_MAX refusals with the same code are recorded per period; one entry counts the others."""


@dataclass
class _Period:
    end_s: float
    entries: int = 0
    suppressed: int = 0


class RefusalAudit:
    """Recorder of refusals in an audit log, if there is one. now_s: monotonic clock."""

    def __init__(self, audit: AuditLog | None, now_s: Callable[[], float] = time.monotonic) -> None:
        self._audit = audit
        self._now_s = now_s
        self._periods: dict[str, _Period] = {}

    def record(self, code: str, fields: AuditFields) -> None:
        """Record a refusal, or count it once the period has its entries. Call it in an event loop."""
        if self._audit is None:
            return
        now_s = self._now_s()
        self._close_periods(now_s)
        period = self._periods.setdefault(code, _Period(now_s + PERIOD_S))
        # By code, so that a flood of one kind of refusal does not hide the others.
        if period.entries < ENTRIES_MAX:
            period.entries += 1
            self._audit.record({**fields, "event": "refused", "code": code})
            return
        # The count is written also if no further refusal comes.
        if not period.suppressed:
            asyncio.get_running_loop().call_later(period.end_s - now_s, self._close_ended)
        period.suppressed += 1

    def flush(self) -> None:
        """Record the counts of all periods, before the audit log closes."""
        self._close_periods(float("inf"))

    def _close_ended(self) -> None:
        self._close_periods(self._now_s())

    def _close_periods(self, now_s: float) -> None:
        for code, period in list(self._periods.items()):
            if now_s >= period.end_s:
                del self._periods[code]
                if period.suppressed and self._audit is not None:
                    self._audit.record({"event": "refused", "code": code, "suppressed": period.suppressed})
