"""The port that a screen reader opens to write the cells of the display.

Theory of operation. A port takes the place of that of a braille display, whose cells are those of the tactile display.
It is a serial port that is a pseudo-terminal, or a socket on this computer.
Dots fall within a second without light, so all cells are streamed again every FRAME_S while any dot is up, and of these
frames the newest wins. A stream whose frames stand refreshes them itself, first where fingers are: it gets the cells
when they change, and again as long as they are not shown. When the reader is gone, the cells are cleared. The end of
this process closes the stream, whose pulses the daemon drops.
"""

import os
import select
import socket
import sys
import termios
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from optodrive.client.brlapi import CellPage
from optodrive.client.cell_places import draw_cells
from optodrive.client.humanware import NAMED_KEYS
from optodrive.client.stream import Stream
from optodrive.core.errors import InputError
from optodrive.link.simulator.pseudo_terminal import check_link_path, open_pty, remove_link
from optodrive.planning.stimuli.pixel_lattice import CellSlot

READ_BYTES = 4096
MISSING_READER_S = 0.05
"""Wait for a reader of a serial port, whose absence ends each wait for its bytes at once."""
HOST, FIRST_PORT, LAST_NUMBER = "127.0.0.1", 4101, 65_535 - 4101
"""Address of BrlAPI's server 0 by TCP; server N has the N-th port after it."""


class ReaderChannel(Protocol):
    """A port or a server that a screen reader opens."""

    def list_descriptors(self) -> list[int]:
        """Return the descriptors to wait for."""

    def receive(self) -> bytes | None:
        """Return the bytes that have arrived. None: a reader is gone, or there is none."""

    def send(self, data: bytes) -> None:
        """Send bytes to the reader. One that does not read loses the rest."""

    def close(self) -> None:
        """Close it, and remove its name."""


class SerialChannel:
    """A serial port that is a pseudo-terminal.

    This process closes the reader's end: a hang-up therefore means that no reader has the port open.
    """

    def __init__(self, link: Path) -> None:
        """Create the port. link: its name. Raises InputError if it cannot be created."""
        check_link_path("PORT", link)
        self._link, self._terminal = link, open_pty(link)
        self._name = link.readlink()
        self._attributes = termios.tcgetattr(self._terminal)

    def list_descriptors(self) -> list[int]:
        """See ReaderChannel."""
        return [self._terminal]

    def receive(self) -> bytes | None:
        """See ReaderChannel. The port's settings are restored for the next reader.

        The C library refuses settings of which a pseudo-terminal takes none: those of a reader before it, with parity.
        """
        try:
            return os.read(self._terminal, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError:  # hang-up
            termios.tcsetattr(self._terminal, termios.TCSANOW, self._attributes)
            time.sleep(MISSING_READER_S)
            return None

    def send(self, data: bytes) -> None:
        """See ReaderChannel."""
        with suppress(BlockingIOError):
            os.write(self._terminal, data)

    def close(self) -> None:
        """See ReaderChannel."""
        remove_link(self._link, self._name)
        os.close(self._terminal)


class SocketChannel:
    """A server of BrlAPI for one client: the next one takes the place of one that has not proved its right."""

    def __init__(self, number: int, page: CellPage) -> None:
        """Open the server of this number. Raises InputError if its port is taken.

        page: answers the clients
        """
        self._page = page
        self._client: socket.socket | None = None
        try:
            self._server = socket.create_server((HOST, FIRST_PORT + number))
        except OSError:
            raise InputError("PORT", number, "the number of a server whose port is free") from None
        self._server.setblocking(False)

    def list_descriptors(self) -> list[int]:
        """See ReaderChannel."""
        return [each.fileno() for each in (self._server, self._client) if each]

    def receive(self) -> bytes | None:
        """See ReaderChannel."""
        with suppress(BlockingIOError):
            client, _ = self._server.accept()
            if self._client and self._page.has_reader:
                client.close()
                return b""
            self._leave()
            client.setblocking(False)
            self._client = client
            self.send(self._page.greeting)
            return None
        if self._client is None:
            return None
        try:
            data = self._client.recv(READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._leave()
        return data or None

    def send(self, data: bytes) -> None:
        """See ReaderChannel."""
        if self._client:
            with suppress(OSError):  # it does not read, or is gone
                self._client.sendall(data)

    def close(self) -> None:
        """See ReaderChannel."""
        self._leave()
        self._server.close()

    def _leave(self) -> None:
        if self._client:
            self._client.close()
        self._client = None


def parse_number(text: str) -> int:
    """Return the number of a server of BrlAPI. Raise InputError for other text."""
    if not text.isdecimal() or int(text) > LAST_NUMBER:
        raise InputError("PORT", text, f"the number of a server of BrlAPI, 0 to {LAST_NUMBER}")
    return int(text)


def read_key(path: Path) -> bytes:
    """Return the key of a file. Raise InputError if there is none."""
    try:
        key = path.read_bytes()
    except OSError as error:
        raise InputError("--key-file", str(path), f"a file that can be read: {error.strerror}") from None
    if not key:
        raise InputError("--key-file", str(path), "a file that is not empty")
    return key


FRAME_S = 0.1
NOT_SHOWN = ("refused", "failed", "stopped")
"""Statuses of frames that were not shown, or not to their end, although no newer one came."""


class CellProtocol(Protocol):
    """A display's side of a protocol of screen readers, without input or output.

    count: of cells; routing_count: of cells that have a routing key, the first ones; cells: the dots of each, bit 0 is
    dot 1, as the reader wrote them last; has_reader: whether there is one
    """

    count: int
    routing_count: int
    cells: bytes
    has_reader: bool

    def receive(self, data: bytes) -> bytes:
        """Process bytes of the reader. Return the answers."""

    def clear(self) -> None:
        """Forget cells and a packet that has arrived in part: the reader is gone."""

    def build_key_press(self, name: str, cell: int | None = None) -> bytes:
        """Build the packets of a key of NAMED_KEYS, or of the routing key over a cell, from 0."""


class ReaderPort:
    """The screen reader at the other end of a port, and the keys of standard input.

    pixels: of each dot of each cell; report: takes a line on what was not shown or not understood
    stands: whether the stream's frames stand
    """

    def __init__(
        self,
        channel: ReaderChannel,
        protocol: CellProtocol,
        stream: Stream,
        pixels: list[CellSlot],
        height_um: float,
        pixel_count: int,
        report: Callable[[str], None],
        stands: bool = False,
    ) -> None:
        self._channel, self._protocol, self._stream, self._report = channel, protocol, stream, report
        self._pixels, self._height_um, self._pixel_count = pixels, height_um, pixel_count
        self._keys = [sys.stdin.fileno()]
        self._shown = bytes(protocol.count)
        self._problem = ""
        self._stands = stands

    def run(self) -> None:
        """Run until an exception ends it."""
        due_s = time.monotonic()
        while True:
            self._take_input(max(0.0, due_s - time.monotonic()))
            is_due = time.monotonic() >= due_s
            self._take_results()
            is_again = any(self._shown) and (not self._stands or bool(self._problem))
            if self._protocol.cells != self._shown or (is_due and is_again):
                self._show(self._protocol.cells)
            if is_due:
                due_s = time.monotonic() + FRAME_S

    def _take_input(self, wait_s: float) -> None:
        descriptors = self._channel.list_descriptors()
        ready, _, _ = select.select(descriptors + self._keys, [], [], wait_s)
        if any(descriptor in ready for descriptor in descriptors):
            data = self._channel.receive()
            if data is None:
                self._protocol.clear()
            elif data:
                self._channel.send(self._protocol.receive(data))
        if any(descriptor in ready for descriptor in self._keys):
            self._press(os.read(self._keys[0], READ_BYTES))

    def _press(self, text: bytes) -> None:
        """Press the keys of the lines of standard input. Without a reader, the next one would find them."""
        if not text:
            self._keys = []
        for line in text.decode(errors="replace").splitlines():
            try:
                name, cell = parse_key(line, self._protocol.routing_count)
                if not self._protocol.has_reader:
                    raise InputError("key", line, "a reader that has opened the port")
                self._channel.send(self._protocol.build_key_press(name, cell))
            except InputError as error:
                self._report(str(error))

    def _show(self, cells: bytes) -> None:
        self._stream.send(draw_cells(cells, self._pixels, self._height_um, self._pixel_count))
        self._shown = cells

    def _take_results(self) -> None:
        for result in self._stream.results():
            if result.status in NOT_SHOWN:
                problem = result.error or (result.problem.detail if result.problem else result.status)
                if problem != self._problem:
                    self._report(f"not shown: {problem}")
                self._problem = problem
            elif result.executed or (self._stands and result.status == "planned"):
                self._problem = ""


def parse_key(text: str, routing_count: int) -> tuple[str, int | None]:
    """Return the name of a key, and of `routing N` the cell from 0. Raise InputError for another name."""
    name, _, number = text.strip().partition(" ")
    if name == "routing" and number.isdecimal() and 1 <= int(number) <= routing_count:
        return name, int(number) - 1
    if name in NAMED_KEYS and not number:
        return name, None
    raise InputError("key", text, f"{', '.join(NAMED_KEYS)}, or routing 1 to {routing_count}")
