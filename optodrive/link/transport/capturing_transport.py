"""Transport that records all bytes of another transport in a link capture."""

from optodrive.core.clock import Clock
from optodrive.link.transport.base import Transport
from optodrive.link.transport.link_capture import CLOSED, FROM_BOARD, OPENED, TO_BOARD, CaptureEntry, LinkCaptureWriter


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
