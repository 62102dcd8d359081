"""Log of the daemon: lines on stderr, or entries with fields if stderr is connected to the journal.

Entries go to the journal's socket as non-blocking datagrams, and to a pipe or terminal only while it accepts them: a
reader that has stalled would block the writers, the engine's loop among them. What the log writes per minute is
bounded, so that no caller can fill a disk with it, and equal lines are merged.
"""

import logging
import os
import select
import socket
import sys
import threading
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Literal

from optodrive.core.clock import Clock, MonotonicClock

WATCHDOG_FRACTION = 0.2
"""Interval between watchdog notifications, as a fraction of the watchdog's timeout."""


class Notifier:
    """Sender of notifications to $NOTIFY_SOCKET. It does nothing if the variable is not set."""

    def __init__(self, clock: Clock, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._clock = clock
        watched = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        allowed_us = environment.get("WATCHDOG_USEC", "")
        self._interval_s = int(allowed_us) * 1e-6 * WATCHDOG_FRACTION if watched and allowed_us.isdigit() else None
        self._fed_s = -float("inf")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    @property
    def is_enabled(self) -> bool:
        """Whether a service manager receives the notifications."""
        return bool(self._address)

    def send(self, *lines: str) -> None:
        """Send assignments such as READY=1."""
        if self._address:
            with suppress(OSError):
                self._socket.sendto("\n".join(lines).encode(), self._address)

    def notify_reloading(self) -> None:
        """Notify the start of a reload, which READY=1 ends."""
        self.send("RELOADING=1", f"MONOTONIC_USEC={round(self._clock.now_s() * 1e6)}")

    def close(self) -> None:
        """Stop sending and close the socket."""
        self._address = ""
        self._socket.close()

    def feed_watchdog(self) -> None:
        """Feed the watchdog if it is due. Only the engine's loop calls it, in every iteration."""
        if self._interval_s is None:
            return
        now_s = self._clock.now_s()
        if now_s - self._fed_s >= self._interval_s:
            self._fed_s = now_s
            self.send("WATCHDOG=1")


JOURNAL = Path("/run/systemd/journal/socket")
LINE_MAX = 8000
BYTES_MAX = 256_000
WRITE_MAX = 4000
"""Bytes per write, not more than a pipe accepts at once when it accepts any."""
PERIOD_S = 60.0
"""At most BYTES_MAX bytes of lines are written per period; the number of those omitted follows in one line."""
REPEATS_MAX = 3
"""Equal lines that are written per period, unless they are events; the number of the others follows in one line."""
DISTINCT_MAX = 200
"""Different lines that are compared per period."""
LogLevel = Literal["err", "warning", "notice", "info"]
PRIORITY: dict[LogLevel, int] = {"err": 3, "warning": 4, "notice": 5, "info": 6}


class DaemonLog:
    """Writer of log lines, for any thread. journal: path of the journal's socket, None for stderr."""

    def __init__(self, journal: Path | None = None, clock: Clock | None = None) -> None:
        self._journal = None if journal is None else str(journal)
        self._clock = clock or MonotonicClock()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._lock = threading.Lock()
        self._period_end_s = 0.0
        self._bytes = self._suppressed = 0
        self._repeats: Counter[str] = Counter()

    def write(self, line: str, level: LogLevel = "info", **fields: object) -> None:
        """Write a line, or drop it on failure. fields: additional upper-case fields, for the journal only."""
        line = line if len(line) <= LINE_MAX else line[:LINE_MAX] + "…"
        with self._lock:
            now_s = self._clock.now_s()
            if now_s >= self._period_end_s:
                self._report_suppressed()
                self._period_end_s, self._bytes = now_s + PERIOD_S, 0
            if "EVENT" not in fields and self._is_repeated(line):
                return
            self._bytes += len(line)
            if self._bytes > BYTES_MAX:
                self._suppressed += 1
                return
            if not self._emit(line, level, fields):
                self._suppressed += 1

    def _is_repeated(self, line: str) -> bool:
        if line in self._repeats or len(self._repeats) < DISTINCT_MAX:
            self._repeats[line] += 1
        return self._repeats[line] > REPEATS_MAX

    def _report_suppressed(self) -> None:
        for line, count in self._repeats.items():
            if count > REPEATS_MAX:
                self._emit(f"{count - REPEATS_MAX} times more: {line}", "warning", {})
        self._repeats.clear()
        if self._suppressed and self._emit(f"{self._suppressed} lines suppressed", "warning", {}):
            self._suppressed = 0

    def _emit(self, line: str, level: LogLevel, fields: dict[str, object]) -> bool:
        """Return whether the line was written. A failing log must not end the daemon."""
        try:
            if self._journal is None:
                return _write_to_stderr(f"optodrive: {line}\n")
            self._socket.sendto(format_entry(line, level, fields), self._journal)
        except OSError:
            return False
        return True

    def warn(self, line: str) -> None:
        """Write a line of level warning."""
        self.write(line, "warning")

    def close(self) -> None:
        """Write the number of suppressed lines and close the socket."""
        with self._lock:
            self._report_suppressed()
        self._socket.close()

    def attach_to_root_logger(self) -> None:
        """Write the log records of libraries from level warning on."""
        handler = _Handler(self)
        handler.setLevel(logging.WARNING)
        logging.getLogger().addHandler(handler)


def _write_to_stderr(text: str) -> bool:
    """Write a text unless its reader has stalled. Return whether all of it was written."""
    try:
        descriptor = sys.stderr.fileno()
    except (OSError, ValueError):  # without a descriptor, nothing waits
        sys.stderr.write(text)
        return True
    data = text.encode(errors="replace")
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    for begin in range(0, len(data), WRITE_MAX):
        if not poll.poll(0):
            return False
        os.write(descriptor, data[begin : begin + WRITE_MAX])  # past the stream's buffer, which keeps a failed text
    return True


def format_entry(line: str, level: LogLevel, fields: dict[str, object]) -> bytes:
    """Return an entry in the journal's native format, in which multi-line values are prefixed with their length."""
    entry_fields = {"MESSAGE": line, "PRIORITY": PRIORITY[level], "SYSLOG_IDENTIFIER": "optodrive"}
    entry_fields |= {f"OPTODRIVE_{name}": value for name, value in fields.items()}
    parts = []
    for name, value in entry_fields.items():
        data = str(value)[:LINE_MAX].encode(errors="backslashreplace")
        if b"\n" in data:
            parts.append(name.encode() + b"\n" + len(data).to_bytes(8, "little") + data + b"\n")
        else:
            parts.append(name.encode() + b"=" + data + b"\n")
    return b"".join(parts)


def open_daemon_log() -> DaemonLog:
    """Return a log to the journal if $JOURNAL_STREAM identifies stderr, else to stderr."""
    with suppress(OSError, ValueError):
        device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
        stderr_stat = os.fstat(2)
        if (stderr_stat.st_dev, stderr_stat.st_ino) == (int(device), int(inode)) and JOURNAL.exists():
            return DaemonLog(JOURNAL)
    return DaemonLog()


class _Handler(logging.Handler):
    def __init__(self, log: DaemonLog) -> None:
        super().__init__()
        self._log = log

    def emit(self, record: logging.LogRecord) -> None:
        level: LogLevel = "err" if record.levelno >= logging.ERROR else "warning"
        self._log.write(self.format(record), level, LOGGER=record.name)
