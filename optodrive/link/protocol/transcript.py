"""Transcript of a link, message by message, from its raw bytes, sans-I/O.

The error counts agree with those of the host and of the board.
"""

from dataclasses import dataclass, field
from statistics import median
from typing import Any, NamedTuple

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import SEQ_MODULUS
from optodrive.link.protocol.framing import ENCODED_MAX, Frame, FrameDecoder

PENDING_MAX = 4 * ENCODED_MAX
PENDING_CLOCKS_MAX = 256


class TranscriptEntry(NamedTuple):
    """One frame, or a run of bytes that is no valid frame.

    message, error: the parsed message and "", or None and the reason
    raw: bytes on the wire without the delimiter
    retransmitted: whether the host had sent the frame before
    """

    host_s: float
    to_board: bool
    frame: Frame | None
    message: m.Message | None
    error: str
    raw: bytes
    retransmitted: bool = False


@dataclass
class TranscriptTotals:
    """Statistics of a transcript.

    board_silence_s, host_silence_s: longest time between bytes of one direction while the link was open
    """

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
        """Return the statistics by name. Round trips are those of CLOCK and CLOCK_REPLY, None without any."""
        trips_s = self.round_trips_s
        return {
            **{name: value for name, value in vars(self).items() if name != "round_trips_s"},
            "round_trip_median_s": median(trips_s) if trips_s else None,
            "round_trip_min_s": min(trips_s, default=None),
            "round_trip_max_s": max(trips_s, default=None),
        }


class _FrameSplitter:
    """Splits the bytes of one direction at the delimiters. A frame has the time of its delimiter."""

    def __init__(self) -> None:
        self._pending = b""

    def feed(self, data: bytes) -> list[bytes]:
        *encoded_frames, rest = (self._pending + data).split(b"\0")
        if len(rest) > PENDING_MAX:  # longer than any frame; the bound limits memory
            encoded_frames.append(rest)
            rest = b""
        self._pending = rest
        return [encoded for encoded in encoded_frames if encoded]


class Transcript:
    """Incremental parser of both directions of a link. It keeps the totals."""

    def __init__(self) -> None:
        self.totals = TranscriptTotals()
        self._splitters = {True: _FrameSplitter(), False: _FrameSplitter()}
        self._last_byte_s: dict[bool, float] = {}
        self._next_seq = 0
        self._clock_request_s: dict[int, float] = {}

    def reset_link(self) -> None:
        """Discard partial frames and silence timers after the link was opened or closed."""
        self._splitters = {True: _FrameSplitter(), False: _FrameSplitter()}
        self._last_byte_s.clear()
        self._clock_request_s.clear()

    def feed(self, host_s: float, to_board: bool, data: bytes) -> list[TranscriptEntry]:
        """Return the entries that `data` completes. to_board: direction."""
        self._record_silence(host_s, to_board)
        return [self._parse_frame(host_s, to_board, encoded) for encoded in self._splitters[to_board].feed(data)]

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
                host_s, to_board, frame, f"{message.NAME} in the wrong direction: an echo", encoded
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
        """Update the totals and return whether the frame is a retransmission."""
        if isinstance(message, m.Hello | m.Abort):
            self._next_seq = 0
        elif isinstance(message, m.Nak):
            self.totals.naks += 1
        elif isinstance(message, m.ClockRequest):
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
