"""Lines of braille cells that BrlAPI clients know: the server's side of BrlAPI's protocol, sans-I/O.

Theory of operation. A packet is the size of its data and its type, four bytes each, most significant first, and the
data. The server greets with its version; the client answers with its own, proves that it may read a key file, asks for
the size of the display, takes it, and writes cells. A client of this kind is BRLTTY itself (`-b ba`), which so drives
several lines, where the serial protocols have one. Facts of the protocol: BRLTTY 6.5, `brlapi_protocol.h`,
`brlapi_client.c`, `brlapi_server.c`. Text without cells is not translated here: BRLTTY sends both.
"""

import hmac
import struct

VERSION = 8
AUTH_KEY = ord("K")
HEADER = struct.Struct(">II")
PACKET_MAX_BYTES = 4096
PARAMETER_VALUE = int.from_bytes(b"PV", "big")
ENTER, LEAVE, WRITE = b"tLw"
ACKNOWLEDGED = {ENTER, LEAVE, *b"muZ", PARAMETER_VALUE}
"""Types that are answered by nothing else: also to ignore and accept keys, and to synchronise."""
NAMES = set(b"nd")
"""Types that ask for the name of the driver, and of the model."""
ILLEGAL_INSTRUCTION, INVALID_PACKET, NOT_SUPPORTED, AUTHENTICATION = 5, 7, 9, 17
"""Codes of errors."""
REGION, TEXT, AND_MASK, OR_MASK, CURSOR, CHARSET = 0x02, 0x04, 0x08, 0x10, 0x20, 0x40
"""Flags of the parts of a write, in their order: its cells are those of the text and the one mask, or the other."""
COMMAND, ROUTE = 0x2000_0000, 0x2001_0000
NAMED_KEYS = {
    "previous": COMMAND | 1,
    "left": COMMAND | 23,
    "right": COMMAND | 24,
    "next": COMMAND | 2,
    "home": COMMAND | 29,
    "cursor-left": 0xFF51,
    "cursor-up": 0xFF52,
    "cursor-right": 0xFF53,
    "cursor-down": 0xFF54,
    "enter": 0xFF0D,
}
"""Codes of the keys: commands of BRLTTY (a line up, a window left, right, a line down; to the cursor) and X11's."""


class PacketError(Exception):
    """A packet that is refused.

    code: the error's
    """

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class CellPage:
    """A display of rows × columns cells, for one client at a time.

    count: of cells; routing_count: of routing keys, one per cell; cells: the dots of each, row after row, bit 0 is
    dot 1, as the client wrote them last; has_reader: whether a client has proved that it may read the key file
    """

    def __init__(self, rows: int, columns: int, key: bytes) -> None:
        self.rows, self.columns, self._key = rows, columns, key
        self.count = self.routing_count = rows * columns
        self.clear()

    @property
    def greeting(self) -> bytes:
        """Packet that a client gets first."""
        return _build_packet(ord("v"), struct.pack(">I", VERSION))

    def clear(self) -> None:
        """Forget cells, a packet that has arrived in part, and the client's right: it is gone."""
        self.cells, self._received = bytes(self.count), b""
        self.has_reader = False
        self._is_taken = False

    def receive(self, data: bytes) -> bytes:
        """Process bytes of the client. Return the answers."""
        self._received += data
        answers = b""
        while len(self._received) >= HEADER.size:
            size, kind = HEADER.unpack_from(self._received)
            if size > PACKET_MAX_BYTES:
                self._received = b""
                return answers + _build_error("e", INVALID_PACKET, kind)
            if len(self._received) < HEADER.size + size:
                break
            packet = self._received[HEADER.size : HEADER.size + size]
            self._received = self._received[HEADER.size + size :]
            answers += self._answer(kind, packet)
        return answers

    def build_key_press(self, name: str, cell: int | None = None) -> bytes:
        """Build the packet of a key of NAMED_KEYS, or of the routing key over a cell, from 0."""
        code = NAMED_KEYS[name] if cell is None else ROUTE | cell
        return _build_packet(ord("k"), struct.pack(">Q", code))

    def _answer(self, kind: int, data: bytes) -> bytes:
        try:
            if kind == ord("v"):
                return _build_packet(ord("a"), struct.pack(">I", AUTH_KEY))
            if kind == ord("a"):
                return self._authorize(data)
            if not self.has_reader:
                raise PacketError(AUTHENTICATION)
            return self._serve(kind, data)
        except PacketError as error:
            # A write is not answered, so that a refused one is an exception, which ends the client's connection.
            return _build_error("E" if kind == WRITE else "e", error.code, kind)

    def _authorize(self, data: bytes) -> bytes:
        if not hmac.compare_digest(data, struct.pack(">I", AUTH_KEY) + self._key):
            raise PacketError(AUTHENTICATION)
        self.has_reader = True
        return _build_packet(ord("A"))

    def _serve(self, kind: int, data: bytes) -> bytes:
        if kind == ord("s"):
            return _build_packet(kind, struct.pack(">II", self.columns, self.rows))
        if kind in NAMES:
            return _build_packet(kind, b"optodrive\0")
        if kind == WRITE:
            self._write(data)
            return b""
        if kind == ord("F"):  # focus of a window: there is none
            return b""
        if kind in ACKNOWLEDGED:
            if kind in (ENTER, LEAVE):
                self._is_taken, self.cells = kind == ENTER, bytes(self.count)
            return _build_packet(ord("A"))
        raise PacketError(NOT_SUPPORTED)  # raw mode, suspending, parameters

    def _write(self, data: bytes) -> None:
        """Take the cells of a write: those of its second mask in its region. A write of nothing clears all."""
        if not self._is_taken:
            raise PacketError(ILLEGAL_INSTRUCTION)
        parts = _Parts(data)
        flags = parts.take_number()
        begin, size = 0, self.count
        if flags & REGION:
            begin, size = parts.take_number() - 1, abs(parts.take_number())
        if not 0 <= begin < begin + size <= self.count:
            raise PacketError(INVALID_PACKET)
        if flags & TEXT:
            parts.take(parts.take_number())
        shown = parts.take(size) if flags & AND_MASK else b"\xff" * size
        cells = parts.take(size) if flags & OR_MASK else bytes(size)
        if flags & CURSOR:
            parts.take_number()
        if flags & CHARSET:
            parts.take(parts.take(1)[0])
        if parts.rest:
            raise PacketError(INVALID_PACKET)
        if flags & TEXT and any(shown):  # dots of the text, which are unknown here
            raise PacketError(NOT_SUPPORTED)
        self.cells = self.cells[:begin] + cells + self.cells[begin + size :]


class _Parts:
    """Parts of a write, taken one after the other."""

    def __init__(self, data: bytes) -> None:
        self.rest = data

    def take(self, size: int) -> bytes:
        if not 0 <= size <= len(self.rest):
            raise PacketError(INVALID_PACKET)
        part, self.rest = self.rest[:size], self.rest[size:]
        return part

    def take_number(self) -> int:
        (number,) = struct.unpack(">i", self.take(4))
        return int(number)


def _build_packet(kind: int, data: bytes = b"") -> bytes:
    return HEADER.pack(len(data), kind) + data


def _build_error(how: str, code: int, kind: int) -> bytes:
    return _build_packet(ord(how), struct.pack(">II", code, kind))
