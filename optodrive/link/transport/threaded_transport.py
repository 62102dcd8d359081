"""Transport that reads another one in a thread, so that its caller never waits in the port's driver.

To poll or read a terminal device, the kernel waits for a worker of normal priority. On a busy computer that takes more
than a lease, even in a process with real-time priority. Writing does not wait for it.
"""

import os
import select
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from optodrive.link.transport.base import Transport, guard_opening, guard_port

READ_S = 0.05
"""Longest wait of a read, and so the delay of closing the port."""
RELEASE_TIMEOUT_S = 1.0


class ThreadedTransport:
    """Wrapper around `transport`. Its descriptor is readable when bytes have arrived or the link has failed."""

    def __init__(self, transport: Transport) -> None:
        self.name = transport.name
        self._transport = transport
        self._reader: _Reader | None = None
        self._last_reader: _Reader | None = None

    def open(self) -> None:
        """Open the link when the previous one is closed, and start to read."""
        if self._last_reader is not None:
            self._last_reader.join()
        try:
            with guard_opening(self.name):
                self._transport.open()
                self._reader = self._last_reader = _Reader(self._transport)
        except Exception:
            self._transport.close()
            raise

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that have arrived. Wait at most timeout_s for the first."""
        with guard_port(self.name):
            return b"" if self._reader is None else self._reader.take(timeout_s)

    def write(self, data: bytes) -> None:
        """Hand data to the operating system, and the rest of it, if there is no room, at the next calls."""
        with guard_port(self.name):
            self._transport.write(data)

    def fileno(self) -> int | None:
        """Return the descriptor that reports received bytes, None if the link is closed."""
        return None if self._reader is None else self._reader.descriptor

    def describe_fault(self) -> str:
        """Return the evident fault of the open link, or an empty text."""
        return self._transport.describe_fault()

    def close(self) -> None:
        """Let the thread close the link after its read. The link may be opened again."""
        self._stop_reader(self._transport.close)

    def _stop_reader(self, close: Callable[[], None]) -> None:
        if self._reader is not None:
            reader, self._reader = self._reader, None
            reader.stop(close)

    def release(self) -> None:
        """Send unsent data and close permanently."""
        self._stop_reader(self._transport.release)
        if self._last_reader is not None:
            self._last_reader.join(RELEASE_TIMEOUT_S)
        self._transport.release()


class _Reader:
    """Thread that reads an open transport until it is stopped or the link fails, and closes it once stopped."""

    def __init__(self, transport: Transport) -> None:
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._transport = transport
        self._chunks: deque[bytes] = deque()
        self._error: Exception | None = None
        self._lock = threading.Lock()
        self._stopped = self._finished = False
        self._close = transport.close
        self._thread = threading.Thread(target=self._run, name="read-port", daemon=True)
        try:
            self._thread.start()
        except RuntimeError:  # there is no room for a thread
            os.close(self.descriptor)
            raise

    def take(self, timeout_s: float) -> bytes:
        if timeout_s > 0.0:
            select.select([self.descriptor], [], [], timeout_s)
        with suppress(BlockingIOError):
            os.eventfd_read(self.descriptor)
        chunks = []
        while self._chunks:
            chunks.append(self._chunks.popleft())
        if not chunks and self._error is not None:
            raise self._error
        return b"".join(chunks)

    def stop(self, close: Callable[[], None]) -> None:
        with self._lock:
            self._stopped, self._close = True, close
            os.close(self.descriptor)
            if self._finished:
                close()

    def join(self, timeout_s: float | None = None) -> None:
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            while not self._stopped:
                data = self._transport.read(READ_S)
                if data:
                    self._chunks.append(data)
                    self._notify()
        except Exception as error:  # raised by take()
            self._error = error
        with self._lock:
            self._finished = True
            if self._stopped:
                self._close()
                return
        self._notify()

    def _notify(self) -> None:
        with self._lock:
            if not self._stopped:
                os.eventfd_write(self.descriptor, 1)
