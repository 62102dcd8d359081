"""Lines of braille cells that screen readers know: the serial protocol of the DotPad, sans-I/O.

A packet is AA 55, the number of the bytes that follow, two bytes, most significant first, the destination, the command,
two bytes, a sequence number, data, and the exclusive or of A5 and the bytes from the destination on. BRLTTY (`-b dp`,
from 6.6 on) and NVDA ask for the board's description, write the cells of a line, and receive keys. Facts of the
protocol: their drivers.

Lines are numbered from 0: those of the text display, then those of the graphic display, whose cells are 4 × 2 dots
without gaps. Both drivers agree on that where there is a text display; without one they number graphic lines apart.
BRLTTY writes its status cells to the text display where it uses the graphic one.
"""

import struct
from functools import reduce
from math import ceil
from operator import xor
from typing import NamedTuple

SYNC = b"\xaa\x55"
LENGTH = struct.Struct(">H")
HEAD = struct.Struct(">BHB")
"""Destination, command and sequence number."""
CHECKSUM_START = 0xA5
PACKET_MAX_BYTES = 512
"""Largest length of a packet that is waited for; the drivers' longest has 86 bytes."""

FIRMWARE, NAME, BOARD, DISPLAY_LINE = 0x0000, 0x0100, 0x0110, 0x0200
"""Requests. The response to each is the next number."""
LINE_SHOWN = 0x0202
PERKINS, ROUTING = 0x0312, 0x0322
"""Notifications of the keys that are held."""
ERROR = 0x9902
ACKNOWLEDGED, NOT_ACKNOWLEDGED, WRONG_CHECKSUM = b"\0", b"\1", b"\3"
"""Codes of the response to a line."""
TEXT_FLAG = 0x80
"""Of the sequence number: bit 0 of a cell is dot 1, as NVDA writes it. Otherwise bits are as in DOTS, as BRLTTY's."""
LENGTH_ERROR, COMMAND_ERROR, CHECKSUM_ERROR = b"\1", b"\2", b"\3"

HAS_GRAPHIC, HAS_TEXT, HAS_PERKINS_KEYS, HAS_ROUTING_KEYS = 0x80, 0x40, 0x20, 0x10
HAS_NAVIGATION_KEYS, HAS_PANNING_KEYS = 0x08, 0x04
EIGHT_DOTS = 1
"""Dots per cell. With six BRLTTY would compute three lines of five, as its internal cells always have four rows."""
REFRESH_STEP_S = 0.1
REFRESH_MAX_S = 25.5
PERKINS_BYTES, ROUTING_BYTES = 4, 8

DOT = dict(zip((7, 3, 2, 1, 4, 5, 6, 8), range(8), strict=True))
SPACE = 8
NAMED_KEYS = {
    "previous": (17,),
    "left": (13,),
    "right": (14,),
    "next": (19,),
    "home": (16,),
    "cursor-up": (SPACE, DOT[1]),
    "cursor-down": (SPACE, DOT[4]),
    "cursor-left": (SPACE, DOT[3]),
    "cursor-right": (SPACE, DOT[6]),
    "enter": (DOT[8],),
}
"""Numbers of the keys that are pressed together: navigation and panning keys, and chords of the braille keyboard."""
DOTS = (1, 2, 3, 7, 4, 5, 6, 8)
"""Dot of each bit of a cell, from bit 0: the left column from the top, then the right one."""


class CellArea(NamedTuple):
    """Lines of cells that are declared together, none where a board has no such display.

    refresh_s: time in which all of its dots rise, of which the protocol can state at most REFRESH_MAX_S
    """

    rows: int
    columns: int
    refresh_s: float

    def describe(self) -> bytes:
        """Return the descriptor: lines, columns, the cell after which a line is divided (none), the time in 0.1 s."""
        return bytes([self.rows, self.columns, 0, ceil(min(self.refresh_s, REFRESH_MAX_S) / REFRESH_STEP_S)])


class CellGrid:
    """A text display and, if it has rows, a graphic one.

    pitch_m: between dots; count: of cells; routing_count: of cells with a routing key; cells: the dots of each, row
    after row, bit 0 is dot 1, as the reader wrote them last; has_reader: whether one has written anything
    """

    def __init__(self, text: CellArea, graphic: CellArea, pitch_m: float) -> None:
        self._text, self._graphic, self._pitch_m = text, graphic, pitch_m
        self._columns = [area.columns for area in (text, graphic) for _ in range(area.rows)]
        self.count = sum(self._columns)
        self.routing_count = min(self.count, 8 * ROUTING_BYTES)
        self.clear()

    def clear(self) -> None:
        """Forget cells and a packet that has arrived in part: the reader is gone."""
        self.cells, self._received = bytes(self.count), b""
        self.has_reader = False

    def receive(self, data: bytes) -> bytes:
        """Process bytes of the reader. Return the answers. Bytes outside a packet are ignored."""
        self.has_reader = True
        self._received += data
        answers = b""
        while (packet := self._take_packet()) is not None:
            answers += self._answer(packet)
        return answers

    def build_key_press(self, name: str, cell: int | None = None) -> bytes:
        """Build the packets of a key of NAMED_KEYS, or of the routing key over a cell, from 0: held and released."""
        if cell is None:
            command, size, keys = PERKINS, PERKINS_BYTES, NAMED_KEYS[name]
        else:
            command, size, keys = ROUTING, ROUTING_BYTES, (cell,)
        held = sum(1 << (8 * size - 1 - key) for key in keys)  # the first key is the highest bit of the first byte
        return build_packet(command, held.to_bytes(size)) + build_packet(command, bytes(size))

    def _take_packet(self) -> bytes | None:
        """Remove the next packet and return it from the destination on. None: none is complete."""
        start = self._received.find(SYNC)
        if start < 0:
            self._received = self._received[-1:] if self._received.endswith(SYNC[:1]) else b""
            return None
        self._received = self._received[start:]
        head = len(SYNC) + LENGTH.size
        if len(self._received) < head:
            return None
        (length,) = LENGTH.unpack_from(self._received, len(SYNC))
        if length > PACKET_MAX_BYTES:
            self._received = self._received[len(SYNC) :]
            return b""
        if len(self._received) < head + length:
            return None
        packet, self._received = self._received[head : head + length], self._received[head + length :]
        return packet

    def _answer(self, packet: bytes) -> bytes:
        if len(packet) < HEAD.size + 1:
            return build_packet(ERROR, LENGTH_ERROR)
        destination, command, sequence = HEAD.unpack_from(packet)
        data = packet[HEAD.size : -1]
        if compute_checksum(packet[:-1]) != packet[-1]:
            if command == DISPLAY_LINE:
                return build_packet(DISPLAY_LINE + 1, WRONG_CHECKSUM, destination)
            return build_packet(ERROR, CHECKSUM_ERROR)
        if command == DISPLAY_LINE:
            return self._write(destination, data, bool(sequence & TEXT_FLAG))
        if command in (FIRMWARE, NAME, BOARD):
            answers = {FIRMWARE: b"1.0     ", NAME: b"optodrive ", BOARD: self._describe()}
            return build_packet(command + 1, answers[command], destination)
        return build_packet(ERROR, COMMAND_ERROR)

    def _describe(self) -> bytes:
        """Return the board's description: keys, dots per cell, pitch in 0.1 mm, no function keys, and displays."""
        features = HAS_TEXT | HAS_PERKINS_KEYS | HAS_ROUTING_KEYS | HAS_NAVIGATION_KEYS | HAS_PANNING_KEYS
        features |= HAS_GRAPHIC if self._graphic.rows else 0
        board = bytes([features, EIGHT_DOTS, round(self._pitch_m * 1e4), 0])
        return board + self._text.describe() + self._graphic.describe()

    def _write(self, line: int, data: bytes, is_text: bool) -> bytes:
        """Take cells of a line: the first one's place, and the cells, none in BRLTTY's status of no cells."""
        columns = self._columns[line] if line < len(self._columns) else 0
        begin, cells = (data[0], data[1:]) if data else (columns, b"\0")
        if not (columns and begin + len(cells) <= columns):
            return build_packet(DISPLAY_LINE + 1, NOT_ACKNOWLEDGED, line)
        place = sum(self._columns[:line]) + begin
        self.cells = (
            self.cells[:place]
            + (cells if is_text else bytes(map(_to_braille, cells)))
            + self.cells[place + len(cells) :]
        )
        shown = build_packet(LINE_SHOWN, ACKNOWLEDGED, line)  # BRLTTY waits for it before it writes again
        return build_packet(DISPLAY_LINE + 1, ACKNOWLEDGED, line) + shown


def build_packet(command: int, data: bytes = b"", destination: int = 0) -> bytes:
    """Build a packet."""
    body = HEAD.pack(destination, command, 0) + data
    return SYNC + LENGTH.pack(len(body) + 1) + body + bytes([compute_checksum(body)])


def compute_checksum(body: bytes) -> int:
    """Compute the checksum of a packet's bytes from the destination on."""
    return reduce(xor, body, CHECKSUM_START)


def _to_braille(cell: int) -> int:
    """Return the dots of a cell with dot 1 as bit 0."""
    return sum(1 << (dot - 1) for bit, dot in enumerate(DOTS) if cell >> bit & 1)
