"""Transcript of a link, message by message, from its raw bytes, sans-I/O.

The error counts agree with those of the host and of the board.
"""

from dataclasses import dataclass, field, fields
from statistics import median
from typing import Any, NamedTuple

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import SEQ_MODULUS
from optodrive.link.protocol.framing import ENCODED_MAX, Frame, FrameDecoder

DUTY_MAX = 65535
RESET_CAUSES = ("power-up", "reset", "brown-out", "watchdog")
DUTY_FIELDS = ("max_duty", "mean_duty")
NONCE_FIELDS = ("host_nonce", "board_nonce", "host_t")


def describe_reset_cause(code: int) -> str:
    """Return the cause of the board's last start as a word, or the number of an unknown cause."""
    return RESET_CAUSES[code] if code < len(RESET_CAUSES) else f"unknown cause {code}"


def describe(message: m.Message) -> dict[str, Any]:
    """Return the fields of a message by name.

    Enumerations become words and nonces become hex strings. Units are part of the names. Points and records become
    columns.
    """
    if isinstance(message, m.Data):
        return {"first_index": message.first_index, **_describe_points(message)}
    if isinstance(message, m.Executed):
        return {"first_index": message.first_index, **_describe_records(message)}
    described: dict[str, Any] = {}
    for item in fields(message):  # type: ignore[arg-type]
        described.update(_describe_field(message, item.name))
    return described


def _describe_field(message: m.Message, name: str) -> dict[str, Any]:
    value, names = getattr(message, name), message.ENUMS.get(name)
    if names is not None:
        return {name: names[value] or None}
    if isinstance(value, m.Limits):
        return {name: describe(value)}
    if isinstance(value, bytes):
        return {name: value.hex()}
    if name in NONCE_FIELDS:
        return {name: f"{value:08x}"}
    if name in DUTY_FIELDS:
        return {name.replace("duty", "duty_fraction"): value / DUTY_MAX}
    if name == "inputs":
        return {name: [input_name for bit, input_name in enumerate(m.INPUTS) if value >> bit & 1]}
    if name == "temperature_dc":
        return {"temperature_c": value / 10.0}
    if name == "reset_cause":
        return {name: describe_reset_cause(value)}
    if name == "firmware":
        return {name: f"{value >> 16}.{value & 0xFFFF}"}
    return {name: value}


def _describe_points(message: m.Data) -> dict[str, Any]:
    x, y, dark_us, on_us, duty = zip(*m.POINT.iter_unpack(message.points), strict=True)
    duty_fraction = [round(value / DUTY_MAX, 6) for value in duty]
    columns = {"x_code": x, "y_code": y, "dark_us": dark_us, "on_us": on_us}
    return {
        "points": len(x),
        **{name: list(values) for name, values in columns.items()},
        "duty_fraction": duty_fraction,
    }


def _describe_records(message: m.Executed) -> dict[str, Any]:
    on_tick, on_ticks, duty = zip(*message.records, strict=True)
    duty_fraction = [round(value / DUTY_MAX, 6) for value in duty]
    return {
        "records": len(on_tick),
        "on_tick": list(on_tick),
        "on_ticks": list(on_ticks),
        "duty_fraction": duty_fraction,
    }


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
