"""A screen reader's side of the DotPad's protocol, after BRLTTY's and NVDA's drivers."""

import os
import termios
import tty
from contextlib import suppress

LINE, NAME, BOARD, FIRMWARE = 0x0200, 0x0100, 0x0110, 0x0000
DOT_BITS = {1: 0x01, 2: 0x02, 3: 0x04, 4: 0x10, 5: 0x20, 6: 0x40, 7: 0x08, 8: 0x80}
"""Of `brldefs-dp.h`."""


def build(command, data=b"", destination=0, sequence=0):
    """Build a packet as `writeRequest` of BRLTTY's driver and `_sendCommand` of NVDA's."""
    body = bytes([destination, command >> 8, command & 0xFF, sequence]) + data
    checksum = 0xA5
    for byte in body:
        checksum ^= byte
    return bytes([0xAA, 0x55, 0, len(body) + 1]) + body + bytes([checksum])


def read(answers):
    """Return packets as (command, destination, data), as `verifyPacket` reads them."""
    packets = []
    while answers:
        assert answers[:2] == b"\xaa\x55"
        length = answers[2] << 8 | answers[3]
        packet, answers = answers[: 4 + length], answers[4 + length :]
        body = packet[4:-1]
        assert packet == build(body[1] << 8 | body[2], body[4:], body[0])
        packets.append((body[1] << 8 | body[2], body[0], body[4:]))
    return packets


def encode(cells):
    """Return cells as BRLTTY's driver writes them: by the table of `MAKE_OUTPUT_TABLE`."""
    return bytes(sum(bit for dot, bit in DOT_BITS.items() if cell >> (dot - 1) & 1) for cell in cells)


def list_held(data):
    """Return the numbers of the held keys, as `updateKeyGroup` of BRLTTY's driver counts them."""
    return {8 * byte + bit for byte, value in enumerate(data) for bit in range(8) if value & 0x80 >> bit}


class DotPadReader:
    """A reader that opens the port and writes cells as BRLTTY does: line by line, each after the one before is shown.

    board: its description; count: of cells, those of the text display first
    """

    def __init__(self, port):
        self._port = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._port, termios.TCSANOW)
        self._received = b""
        self._send(build(BOARD))
        _, _, self.board = self.take(BOARD + 1)
        text_rows, text_columns, _, _, graphic_rows, graphic_columns, _, _ = self.board[4:]
        self._columns = [text_columns] * text_rows + [graphic_columns] * graphic_rows
        self.count = sum(self._columns)

    def write(self, cells):
        cells = cells.ljust(self.count, b"\0")
        for line, columns in enumerate(self._columns):
            self._send(build(LINE, b"\0" + encode(cells[:columns]), line))
            cells = cells[columns:]
            assert self.take(LINE + 1)[1:] == (line, b"\0")
            assert self.take(LINE + 2)[1:] == (line, b"\0")

    def take(self, command):
        """Return the next packet, which has this command."""
        while not (len(self._received) > 3 and len(self._received) >= 4 + int.from_bytes(self._received[2:4])):
            self._received += os.read(self._port, 100)
        size = 4 + int.from_bytes(self._received[2:4])
        ((found, *rest),) = read(self._received[:size])
        self._received = self._received[size:]
        assert found == command, hex(found)
        return found, *rest

    def kill(self):
        self.close()

    def close(self):
        with suppress(OSError):
            os.close(self._port)

    def _send(self, data):
        os.write(self._port, data)
