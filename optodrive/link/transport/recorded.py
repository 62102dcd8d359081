"""Any transport, with every byte that passes noted on a tape."""

from optodrive.core.clock import Clock
from optodrive.link.transport.base import Transport
from optodrive.link.transport.link_capture import CLOSED, FROM_BOARD, OPENED, TO_BOARD, Entry, TapeWriter


class RecordedTransport:
    """Does what `transport` does; the tape cannot stop or delay it."""

    def __init__(self, transport: Transport, tape: TapeWriter, clock: Clock) -> None:
        self.name = transport.name
        self._transport = transport
        self._tape = tape
        self._clock = clock
        self._open = False

    def _note(self, kind: str, data: bytes = b"") -> None:
        self._tape.note(Entry(kind, self._clock.now_s(), data))

    def open(self) -> None:
        """Open the link; noted once it is open."""
        self._transport.open()
        self._open = True
        self._note(OPENED)

    def read(self, timeout_s: float) -> bytes:
        """Bytes that have arrived; waits at most timeout_s for the first."""
        data = self._transport.read(timeout_s)
        if data:
            self._note(FROM_BOARD, data)
        return data

    def write(self, data: bytes) -> None:
        """Hand all of data to the operating system; noted before, for an answer must not come first."""
        self._note(TO_BOARD, data)
        self._transport.write(data)

    def close(self) -> None:
        """Close the link, which may be opened again."""
        self._note_closed()
        self._transport.close()

    def release(self) -> None:
        """Close for good, and end the tape."""
        self._note_closed()
        self._transport.release()
        self._tape.close()

    def _note_closed(self) -> None:
        if self._open:
            self._open = False
            self._note(CLOSED)
