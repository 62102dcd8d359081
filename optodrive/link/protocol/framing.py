"""Frames on the wire: COBS (Cheshire & Baker 1999) with a zero delimiter and zlib's CRC-32.

raw frame: u8 type | u8 seq | u16 session | body | u32 CRC of all preceding bytes; little-endian, at most RAW_MAX bytes
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple
from zlib import crc32

from optodrive.core.errors import LocalProtocolError

RAW_MAX = 252
HEADER = struct.Struct("<BBH")
CRC = struct.Struct("<I")
BODY_MAX = RAW_MAX - HEADER.size - CRC.size
ENCODED_MAX = RAW_MAX + 1
"""COBS adds one byte to fewer than 254 bytes. The delimiter is not included."""


class Frame(NamedTuple):
    """Frame with a valid CRC."""

    type: int
    seq: int
    session: int
    body: bytes


@dataclass
class FrameCounters:
    """Counters of invalid input: wrong CRC, and bytes that are no COBS frame of valid length."""

    crc_errors: int = 0
    format_errors: int = 0


def cobs_encode(raw: bytes) -> bytes:
    """Return the COBS encoding, without delimiter, of at most RAW_MAX bytes."""
    if len(raw) > RAW_MAX:
        raise LocalProtocolError(f"a frame of {len(raw)} bytes is longer than {RAW_MAX}")
    return b"".join(bytes((len(run) + 1,)) + run for run in raw.split(b"\0"))


def cobs_decode(encoded: bytes) -> bytes | None:
    """Return the decoded bytes, or None if the input is not COBS or decodes to more than RAW_MAX bytes."""
    runs = []
    position = 0
    while position < len(encoded):
        code = encoded[position]
        if code == 0 or code > ENCODED_MAX or position + code > len(encoded):
            return None
        runs.append(encoded[position + 1 : position + code])
        position += code
    raw = b"\0".join(runs)
    return raw if runs and len(raw) <= RAW_MAX else None


def encode_frame(frame: Frame) -> bytes:
    """Return the bytes of a frame on the wire, delimiter included."""
    raw = HEADER.pack(frame.type, frame.seq, frame.session) + frame.body
    return cobs_encode(raw + CRC.pack(crc32(raw))) + b"\0"


class FrameDecoder:
    """Incremental decoder from bytes to frames. Invalid input only increases the counters."""

    def __init__(self) -> None:
        self.counters = FrameCounters()
        self._pending = b""
        self._overlong = False

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Yield the frames that `data` completes."""
        *complete, rest = (self._pending + data).split(b"\0")
        self._pending = rest
        for encoded in complete:
            # The end of a frame whose beginning was thrown away: without its head it would be read as another one.
            if self._overlong:
                self._overlong = False
            elif encoded:
                frame = self._decode_frame(encoded)
                if frame is not None:
                    yield frame
        # Bounded: a port without delimiters, as of another device, must not fill the memory.
        if len(self._pending) > ENCODED_MAX:
            if not self._overlong:
                self.counters.format_errors += 1
            self._overlong = True
            self._pending = b""

    def _decode_frame(self, encoded: bytes) -> Frame | None:
        raw = cobs_decode(encoded)
        if raw is None or len(raw) < HEADER.size + CRC.size:
            self.counters.format_errors += 1
            return None
        content, (crc,) = raw[: -CRC.size], CRC.unpack(raw[-CRC.size :])
        # Silently: an answer to a damaged frame could be damaged itself, and the time-out repeats what matters.
        if crc32(content) != crc:
            self.counters.crc_errors += 1
            return None
        kind, seq, session = HEADER.unpack(content[: HEADER.size])
        return Frame(kind, seq, session, content[HEADER.size :])
