"""What passed on a link, message by message, from its raw bytes; sans-I/O. Counts as the host and the board count."""

from dataclasses import dataclass, field
from statistics import median
from typing import Any, NamedTuple

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import SEQ_MODULUS
from optodrive.link.protocol.describe import name_of
from optodrive.link.protocol.framing import ENCODED_MAX, Frame, FrameDecoder

PENDING_MAX = 4 * ENCODED_MAX
CLOCKS_ASKED_MAX = 256


class Line(NamedTuple):
    """One frame, or bytes that are none. message: None then, and bad says why; raw: as on the wire, no delimiter."""

    host_s: float
    to_board: bool
    frame: Frame | None
    message: m.Message | None
    bad: str
    raw: bytes
    again: bool = False


@dataclass
class Totals:
    """Figures of a whole transcript. Silences are between bytes of the same direction while the link was open."""

    frames_to_board: int = 0
    frames_from_board: int = 0
    bad_frames_to_board: int = 0
    bad_frames_from_board: int = 0
    bad_bytes: int = 0
    retransmissions: int = 0
    naks: int = 0
    board_silence_s: float = 0.0
    host_silence_s: float = 0.0
    round_trips_s: list[float] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """As a dict of numbers; round trip: of CLOCK and its reply, None where there was none."""
        trips_s = self.round_trips_s
        return {
            **{name: value for name, value in vars(self).items() if name != "round_trips_s"},
            "round_trip_median_s": median(trips_s) if trips_s else None,
            "round_trip_least_s": min(trips_s, default=None),
            "round_trip_most_s": max(trips_s, default=None),
        }


class _Direction:
    """One direction's bytes to frames, with what is none; a frame counts at the time of its delimiter."""

    def __init__(self) -> None:
        self._pending = b""

    def feed(self, data: bytes) -> list[bytes]:
        *pieces, rest = (self._pending + data).split(b"\0")
        if len(rest) > PENDING_MAX:  # no frame is so long: it is shown as it is, and memory stays bounded
            pieces.append(rest)
            rest = b""
        self._pending = rest
        return [piece for piece in pieces if piece]


class Transcript:
    """Takes bytes with their times and directions; gives lines, and keeps totals."""

    def __init__(self) -> None:
        self.totals = Totals()
        self._directions = {True: _Direction(), False: _Direction()}
        self._last_s: dict[bool, float] = {}
        self._new_seq = 0
        self._clock_asked_s: dict[int, float] = {}

    def broken_off(self) -> None:
        """The link was opened or closed: half a frame is none, and what follows is no silence."""
        self._directions = {True: _Direction(), False: _Direction()}
        self._last_s.clear()
        self._clock_asked_s.clear()

    def take(self, host_s: float, to_board: bool, data: bytes) -> list[Line]:
        """Lines completed by these bytes."""
        self._note_silence(host_s, to_board)
        return [self._line(host_s, to_board, piece) for piece in self._directions[to_board].feed(data)]

    def _note_silence(self, host_s: float, to_board: bool) -> None:
        silence_s = host_s - self._last_s.get(to_board, host_s)
        self._last_s[to_board] = host_s
        totals = self.totals
        if to_board:
            totals.host_silence_s = max(totals.host_silence_s, silence_s)
        else:
            totals.board_silence_s = max(totals.board_silence_s, silence_s)

    def _line(self, host_s: float, to_board: bool, piece: bytes) -> Line:
        decoder = FrameDecoder()
        frame = next(decoder.feed(piece + b"\0"), None)
        if frame is None:
            why = "wrong CRC" if decoder.counters.crc_errors else "no COBS frame"
            return self._bad(host_s, to_board, None, why, piece)
        try:
            message = m.parse_message(frame.type, frame.body)
        except RemoteProtocolError as error:
            return self._bad(host_s, to_board, frame, str(error), piece)
        if isinstance(message, m.BOARD_MESSAGES) == to_board:
            return self._bad(host_s, to_board, frame, f"{name_of(message)} in the wrong direction: an echo", piece)
        if to_board:
            self.totals.frames_to_board += 1
        else:
            self.totals.frames_from_board += 1
        return Line(host_s, to_board, frame, message, "", piece, self._count(host_s, frame, message))

    def _bad(self, host_s: float, to_board: bool, frame: Frame | None, why: str, piece: bytes) -> Line:
        self.totals.bad_bytes += len(piece)
        if to_board:
            self.totals.bad_frames_to_board += 1
        else:
            self.totals.bad_frames_from_board += 1
        return Line(host_s, to_board, frame, None, why, piece)

    def _count(self, host_s: float, frame: Frame, message: m.Message) -> bool:
        """Whether the frame was sent before; counts what it tells."""
        if isinstance(message, m.Hello | m.Abort):
            self._new_seq = 0
        elif isinstance(message, m.Nak):
            self.totals.naks += 1
        elif isinstance(message, m.Clock):
            if len(self._clock_asked_s) >= CLOCKS_ASKED_MAX:
                self._clock_asked_s.clear()
            self._clock_asked_s[message.host_t] = host_s
        elif isinstance(message, m.ClockReply):
            asked_s = self._clock_asked_s.pop(message.host_t, None)
            if asked_s is not None:
                self.totals.round_trips_s.append(host_s - asked_s)
        elif message.SEQUENCED:
            if frame.seq != self._new_seq:
                self.totals.retransmissions += 1
                return True
            self._new_seq = (self._new_seq + 1) % SEQ_MODULUS
        return False
