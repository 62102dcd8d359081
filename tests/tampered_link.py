"""A link to a simulated board whose reports a proxy falsifies for a while, with a right CRC."""

import re
import struct
from dataclasses import fields
from typing import NamedTuple

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, FrameDecoder, encode_frame
from optodrive.link.simulator.virtual_run import MemoryLink

NAMES = {
    "HELLO_REPLY": "major minor host_nonce session firmware uid capabilities tick_hz queue_points rx_window cell_codes "
    "cells window_pulses reset_cause " + " ".join(f"limits.{item.name}" for item in fields(m.Limits)),
    "EXECUTED": "first_index base_tick record.offset record.on_ticks record.duty",
}
"""Fields of the messages that are more than one structure, in the order of the bytes."""
LAYOUTS = {
    "HELLO_REPLY": m.HelloReply.LAYOUT.format + m.Limits.LAYOUT.format[1:],
    "EXECUTED": m.Executed.LAYOUT.format + m.RECORD.format[1:],
}


class Field(NamedTuple):
    """One field of a message from the board. at: offsets of its first byte in a body of one record."""

    message: str
    name: str
    type: int
    at: int
    size: int


def list_fields():
    """Return all fields of all messages from the board, and the session of their header."""
    found = []
    for kind in m.BOARD_MESSAGES:
        layout = LAYOUTS.get(kind.NAME, kind.LAYOUT.format)
        names = NAMES[kind.NAME].split() if kind.NAME in NAMES else [item.name for item in fields(kind)]
        codes = re.findall(r"\d*[a-zA-Z]", layout)
        at = 0
        for name, code in zip(names, codes, strict=True):
            size = struct.calcsize("<" + code)
            found.append(Field(kind.NAME, name, kind.TYPE, at, size))
            at += size
        found.append(Field(kind.NAME, "session", kind.TYPE, -1, 2))
    return found


FIELDS = list_fields()


class TamperedLink(MemoryLink):
    """In-memory link on which falsify(value, maximum) replaces fields in the board's messages until until_s."""

    def __init__(self, core, clock):
        super().__init__(core, clock)
        self._decoder = FrameDecoder()
        self.until_s = 0.0
        self.fields = ()
        self.falsify = None
        self.count = 0

    def tamper(self, fields, falsify, for_s):
        """Falsify fields for a while from now on."""
        self.fields, self.falsify, self.until_s = fields, falsify, self._clock.now_s() + for_s

    def read(self, timeout_s):
        data = super().read(timeout_s)
        if self._clock.now_s() >= self.until_s:
            self._decoder = FrameDecoder()
            return data
        return b"".join(encode_frame(self._falsify(frame)) for frame in self._decoder.feed(data))

    def _falsify(self, frame):
        for field in self.fields:
            if field.type == frame.type:
                frame = self._falsify_field(frame, field)
        return frame

    def _falsify_field(self, frame, field):
        self.count += 1
        if field.at < 0:
            return frame._replace(session=self.falsify(frame.session, 0xFFFF))
        body, step = bytearray(frame.body), m.RECORD.size if field.name.startswith("record.") else len(frame.body)
        for at in range(field.at, len(body), step):
            value = int.from_bytes(body[at : at + field.size], "little")
            falsified = self.falsify(value, 256**field.size - 1)
            body[at : at + field.size] = falsified.to_bytes(field.size, "little")
        return Frame(frame.type, frame.seq, frame.session, bytes(body))
