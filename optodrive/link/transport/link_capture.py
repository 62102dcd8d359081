"""Link capture: an append-only file of a link's bytes with their times.

file: MAGIC | u32 version | f64 host time | f64 Unix time, both at the start of the capture
entry: u8 kind | f64 host time, s | u32 length | bytes | u32 CRC-32 of the preceding bytes of the entry; little-endian

A reader ignores everything from the first incomplete entry on.
"""

import struct
import threading
import time
from collections.abc import Callable, Iterator
from math import isfinite
from pathlib import Path
from queue import Full, Queue
from typing import BinaryIO, NamedTuple
from zlib import crc32

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, refuse_os_error
from optodrive.link.transport.base import Transport

MAGIC = b"ODWIRE\r\n"
VERSION = 1
HEADER = struct.Struct("<8sIdd")
ENTRY = struct.Struct("<BdI")
CRC = struct.Struct("<I")
KINDS = ("to board", "from board", "opened", "closed")
TO_BOARD, FROM_BOARD, OPENED, CLOSED = KINDS
DATA_MAX = 1 << 20
QUEUE_MAX = 8192
"""Maximum number of entries waiting for the disk. An entry holds a few hundred bytes."""


class CaptureEntry(NamedTuple):
    """Event on the link.

    kind: one of KINDS; host_s: monotonic time; data: empty for opened and closed
    """

    kind: str
    host_s: float
    data: bytes = b""


class LinkCaptureWriter:
    """Writer of a link capture. Its own thread writes to the disk, so a slow disk does not block the link.

    recording: whether entries are still written
    warn: called once if writing fails
    """

    def __init__(self, path: Path, host_s: float, warn: Callable[[str], None]) -> None:
        """Create the file. Raise InputError if it exists or cannot be written."""
        self.path = path
        self.recording = True
        self._warn = warn
        self._queue: Queue[CaptureEntry | None] = Queue(QUEUE_MAX)
        try:
            self._file: BinaryIO = path.open("xb", buffering=0)
            self._file.write(HEADER.pack(MAGIC, VERSION, host_s, time.time()))
        except FileExistsError:
            raise InputError("--capture", str(path), "a name that is free: nothing is overwritten") from None
        except OSError as error:
            raise InputError("--capture", str(path), f"a file that can be written ({error.strerror})") from None
        self._thread = threading.Thread(target=self._write_all, name="link-capture", daemon=True)
        self._thread.start()

    def record(self, entry: CaptureEntry) -> None:
        """Queue an entry for writing. Never block and never raise."""
        if not self.recording:
            return
        try:
            self._queue.put_nowait(entry)
        except Full:
            self._stop(f"the disk is too slow, {QUEUE_MAX} entries are waiting")

    def close(self) -> None:
        """Write the waiting entries and close the file."""
        try:
            self._queue.put(None, timeout=1.0)
        except Full:
            return
        self._thread.join(timeout=5.0)

    def _stop(self, reason: str) -> None:
        # Both the calling thread and the writer thread may stop the capture. Only the first one warns.
        was_recording, self.recording = self.recording, False
        if was_recording:
            self._warn(f"capture to {self.path} stopped: {reason}; the session continues")

    def _write_all(self) -> None:
        try:
            with self._file:  # whose close may fail, too
                while (entry := self._queue.get()) is not None:
                    self._write(pack_entry(entry))
        except OSError as error:
            self._stop(error.strerror or str(error))

    def _write(self, packed: bytes) -> None:
        while packed:
            packed = packed[self._file.write(packed) :]


def pack_entry(entry: CaptureEntry) -> bytes:
    """Return the bytes of an entry in the file."""
    content = ENTRY.pack(KINDS.index(entry.kind), entry.host_s, len(entry.data)) + entry.data
    return content + CRC.pack(crc32(content))


class LinkCapture:
    """Reader of a link capture.

    ignored_bytes: bytes after the last complete entry, known after read_entries()
    host_s, unix_s: monotonic time and Unix time at the start of the capture
    """

    def __init__(self, path: Path) -> None:
        """Read the header. Raise InputError if the file is no capture or has another version."""
        self.path = path
        self.ignored_bytes = 0
        with self._open() as file:
            header = file.read(HEADER.size)
        if len(header) < HEADER.size or not header.startswith(MAGIC):
            raise InputError(str(path), header[:8], "a link capture, as `serve --capture` writes it")
        _, version, self.host_s, self.unix_s = HEADER.unpack(header)
        if version != VERSION:
            raise InputError(f"{path}: version", version, f"{VERSION}, the one this release reads")
        if not (isfinite(self.host_s) and isfinite(self.unix_s)):
            raise InputError(f"{path}: start", (self.host_s, self.unix_s), "finite times")

    def _open(self) -> BinaryIO:
        with refuse_os_error(self.path, "a file that can be read"):
            return self.path.open("rb")

    def read_entries(self) -> Iterator[CaptureEntry]:
        """Yield every complete entry in order. Count the bytes after the last one as ignored."""
        with self._open() as file:
            file.seek(HEADER.size)
            whole_end = HEADER.size
            while (entry := _read_entry(file)) is not None:
                whole_end = file.tell()
                yield entry
            self.ignored_bytes = file.seek(0, 2) - whole_end


def _read_entry(file: BinaryIO) -> CaptureEntry | None:
    header = file.read(ENTRY.size)
    if len(header) < ENTRY.size:
        return None
    kind, host_s, length = ENTRY.unpack(header)
    if kind >= len(KINDS) or length > DATA_MAX or not isfinite(host_s):
        return None
    data, crc_bytes = file.read(length), file.read(CRC.size)
    if len(crc_bytes) < CRC.size or CRC.unpack(crc_bytes)[0] != crc32(header + data):
        return None
    return CaptureEntry(KINDS[kind], host_s, data)


class CapturingTransport:
    """Wrapper around `transport`. The capture can neither stop nor delay it."""

    def __init__(self, transport: Transport, capture: LinkCaptureWriter, clock: Clock) -> None:
        self.name = transport.name
        self._transport = transport
        self._capture = capture
        self._clock = clock
        self._open = False

    def _record(self, kind: str, data: bytes = b"") -> None:
        self._capture.record(CaptureEntry(kind, self._clock.now_s(), data))

    def open(self) -> None:
        """Open the link and then record the event."""
        self._transport.open()
        self._open = True
        self._record(OPENED)

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that have arrived. Wait at most timeout_s for the first."""
        data = self._transport.read(timeout_s)
        if data:
            self._record(FROM_BOARD, data)
        return data

    def write(self, data: bytes) -> None:
        """Hand data to the operating system. Record it first, so that it precedes its answer in the capture."""
        if data:
            self._record(TO_BOARD, data)
        self._transport.write(data)

    def fileno(self) -> int | None:
        """Return the descriptor of the link, None without one."""
        return self._transport.fileno()

    def describe_fault(self) -> str:
        """Return the evident fault of the open link, or an empty text."""
        return self._transport.describe_fault()

    def close(self) -> None:
        """Close the link. It may be opened again."""
        self._record_close()
        self._transport.close()

    def release(self) -> None:
        """Close permanently and close the capture."""
        self._record_close()
        self._transport.release()
        self._capture.close()

    def _record_close(self) -> None:
        if self._open:
            self._open = False
            self._record(CLOSED)
