"""What passed on a link, message by message, from its raw bytes; sans-I/O. Counts as the host and the board count."""

from dataclasses import dataclass, field
from statistics import median
from typing import Any, NamedTuple

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import SEQ_MODULUS
from optodrive.link.protocol.describe import message_name
from optodrive.link.protocol.framing import ENCODED_MAX, Frame, FrameDecoder

PENDING_MAX = 4 * ENCODED_MAX
PENDING_CLOCKS_MAX = 256


class TranscriptEntry(NamedTuple):
    """One frame, or bytes that are none. message: None then, and bad says why; raw: as on the wire, no delimiter."""

    host_s: float
    to_board: bool
    frame: Frame | None
    message: m.Message | None
    error: str
    raw: bytes
    retransmitted: bool = False


@dataclass
class TranscriptTotals:
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

    def to_dict(self) -> dict[str, Any]:
        """As a dict of numbers; round trip: of CLOCK and its reply, None where there was none."""
        trips_s = self.round_trips_s
        return {
            **{name: value for name, value in vars(self).items() if name != "round_trips_s"},
            "round_trip_median_s": median(trips_s) if trips_s else None,
            "round_trip_least_s": min(trips_s, default=None),
            "round_trip_most_s": max(trips_s, default=None),
        }


class _FrameSplitter:
    """One direction's bytes to frames, with what is none; a frame counts at the time of its delimiter."""

    def __init__(self) -> None:
        self._pending = b""

    def feed(self, data: bytes) -> list[bytes]:
        *encoded_frames, rest = (self._pending + data).split(b"\0")
        if len(rest) > PENDING_MAX:  # no frame is so long: it is shown as it is, and memory stays bounded
            encoded_frames.append(rest)
            rest = b""
        self._pending = rest
        return [piece for piece in encoded_frames if piece]


class Transcript:
    """Takes bytes with their times and directions; gives lines, and keeps totals."""

    def __init__(self) -> None:
        self.totals = TranscriptTotals()
        self._splitters = {True: _FrameSplitter(), False: _FrameSplitter()}
        self._last_byte_s: dict[bool, float] = {}
        self._next_seq = 0
        self._clock_request_s: dict[int, float] = {}

    def reset_link(self) -> None:
        """The link was opened or closed: half a frame is none, and what follows is no silence."""
        self._splitters = {True: _FrameSplitter(), False: _FrameSplitter()}
        self._last_byte_s.clear()
        self._clock_request_s.clear()

    def feed(self, host_s: float, to_board: bool, data: bytes) -> list[TranscriptEntry]:
        """Lines completed by these bytes."""
        self._record_silence(host_s, to_board)
        return [self._parse_frame(host_s, to_board, piece) for piece in self._splitters[to_board].feed(data)]

    def _record_silence(self, host_s: float, to_board: bool) -> None:
        silence_s = host_s - self._last_byte_s.get(to_board, host_s)
        self._last_byte_s[to_board] = host_s
        totals = self.totals
        if to_board:
            totals.host_silence_s = max(totals.host_silence_s, silence_s)
        else:
            totals.board_silence_s = max(totals.board_silence_s, silence_s)

    def _parse_frame(self, host_s: float, to_board: bool, encoded: bytes) -> TranscriptEntry:
        decoder = FrameDecoder()
        frame = next(decoder.feed(encoded + b"\0"), None)
        if frame is None:
            error_text = "wrong CRC" if decoder.counters.crc_errors else "no COBS frame"
            return self._record_bad_frame(host_s, to_board, None, error_text, encoded)
        try:
            message = m.parse_message(frame.type, frame.body)
        except RemoteProtocolError as error:
            return self._record_bad_frame(host_s, to_board, frame, str(error), encoded)
        if isinstance(message, m.BOARD_MESSAGES) == to_board:
            return self._record_bad_frame(
                host_s, to_board, frame, f"{message_name(message)} in the wrong direction: an echo", encoded
            )
        if to_board:
            self.totals.frames_to_board += 1
        else:
            self.totals.frames_from_board += 1
        return TranscriptEntry(
            host_s, to_board, frame, message, "", encoded, self._record_frame(host_s, frame, message)
        )

    def _record_bad_frame(
        self, host_s: float, to_board: bool, frame: Frame | None, error_text: str, encoded: bytes
    ) -> TranscriptEntry:
        self.totals.bad_bytes += len(encoded)
        if to_board:
            self.totals.bad_frames_to_board += 1
        else:
            self.totals.bad_frames_from_board += 1
        return TranscriptEntry(host_s, to_board, frame, None, error_text, encoded)

    def _record_frame(self, host_s: float, frame: Frame, message: m.Message) -> bool:
        """Whether the frame was sent before; counts what it tells."""
        if isinstance(message, m.Hello | m.Abort):
            self._next_seq = 0
        elif isinstance(message, m.Nak):
            self.totals.naks += 1
        elif isinstance(message, m.Clock):
            if len(self._clock_request_s) >= PENDING_CLOCKS_MAX:
                self._clock_request_s.clear()
            self._clock_request_s[message.host_t] = host_s
        elif isinstance(message, m.ClockReply):
            request_s = self._clock_request_s.pop(message.host_t, None)
            if request_s is not None:
                self.totals.round_trips_s.append(host_s - request_s)
        elif message.SEQUENCED:
            if frame.seq != self._next_seq:
                self.totals.retransmissions += 1
                return True
            self._next_seq = (self._next_seq + 1) % SEQ_MODULUS
        return False
