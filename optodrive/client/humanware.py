"""A line of braille cells that screen readers know: the serial protocol of HumanWare's Brailliant displays, sans-I/O.

A packet is ESC, its type, the number of its data bytes and these. BRLTTY (`-b hw`) and NVDA identify the display with
INIT, write all cells with DISPLAY and receive keys. Facts of the protocol: drivers of BRLTTY 6.5 and NVDA.
"""

ESC = 0x1B
INIT, INIT_REPLY = 0x00, 0x01
DISPLAY = 0x02
GET_KEYS, KEYS = 0x03, 0x04
KEY_DOWN, KEY_UP = 0x05, 0x06
GET_FIRMWARE, FIRMWARE = 0x0C, 0x0D
KEEP_AWAKE, AWAKE = 0x0E, 0x0F

HEADER_BYTES = 3
MODEL = 0x10
"""Display with thumb keys and a braille keyboard; the reader takes the number of cells from INIT_REPLY."""
CELLS_MAX = 80
DOT = {dot: dot + 1 for dot in range(1, 9)}
SPACE = 10
NAMED_KEYS = {
    "previous": (17,),
    "left": (18,),
    "right": (19,),
    "next": (20,),
    "home": (18, 19),
    "cursor-up": (SPACE, DOT[1]),
    "cursor-down": (SPACE, DOT[4]),
    "cursor-left": (SPACE, DOT[3]),
    "cursor-right": (SPACE, DOT[6]),
    "enter": (DOT[8],),
}
"""Numbers of the keys that are pressed together.

Thumb keys for reading: a line up, a window left, right, a line down; to the cursor. Keys of a keyboard are chords of
the braille keyboard by BRLTTY's table `chords.kti`, because this model has no joystick.
"""
FIRST_ROUTING_KEY = 80
"""Number of the routing key over the first cell."""


class CellLine:
    """A display of `count` cells, at most CELLS_MAX.

    routing_count: of routing keys, one per cell; cells: the dots of each, bit 0 is dot 1, as the reader wrote them
    last; has_reader: whether one has written anything
    """

    def __init__(self, count: int) -> None:
        self.count = self.routing_count = count
        self.clear()

    def receive(self, data: bytes) -> bytes:
        """Process bytes of the reader. Return the answers. Bytes outside a packet are ignored."""
        self.has_reader = True
        self._received += data
        answers = b""
        while (packet := self._take_packet()) is not None:
            answers += self._answer(*packet)
        return answers

    def clear(self) -> None:
        """Forget cells and a packet that has arrived in part: the reader is gone."""
        self.cells, self._received = bytes(self.count), b""
        self.has_reader = False

    def build_key_press(self, name: str, cell: int | None = None) -> bytes:
        """Build the packets of a key of NAMED_KEYS, or of the routing key over a cell, from 0: pressed and released."""
        keys = NAMED_KEYS[name] if cell is None else (FIRST_ROUTING_KEY + cell,)
        downs = [build_packet(KEY_DOWN, bytes([key])) for key in keys]
        return b"".join(downs + [build_packet(KEY_UP, bytes([key])) for key in reversed(keys)])

    def _take_packet(self) -> tuple[int, bytes] | None:
        """Remove and return the next packet as (type, data), None if none is complete."""
        self._received = self._received[self._received.find(ESC) :] if ESC in self._received else b""
        if len(self._received) < HEADER_BYTES:
            return None
        _, kind, length = self._received[:HEADER_BYTES]
        if len(self._received) < HEADER_BYTES + length:
            return None
        data = self._received[HEADER_BYTES : HEADER_BYTES + length]
        self._received = self._received[HEADER_BYTES + length :]
        return kind, data

    def _answer(self, kind: int, data: bytes) -> bytes:
        if kind == DISPLAY:
            self.cells = data[: self.count].ljust(self.count, b"\0")
        answers = {
            INIT: (INIT_REPLY, bytes([0, MODEL, self.count])),  # 0: initialised
            GET_KEYS: (KEYS, b""),  # none is held
            GET_FIRMWARE: (FIRMWARE, bytes([1, 0, 0])),
            KEEP_AWAKE: (AWAKE, b""),
        }
        return build_packet(*answers[kind]) if kind in answers else b""


def build_packet(kind: int, data: bytes = b"") -> bytes:
    """Build a packet."""
    return bytes([ESC, kind, len(data)]) + data
