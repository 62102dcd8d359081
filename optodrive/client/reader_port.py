"""The port that a screen reader opens to write the cells of the display.

Theory of operation. A port takes the place of that of a braille display, whose cells are those of the tactile display.
Dots fall within a second without light, so all cells are streamed again every FRAME_S while any dot is up, and of these
frames the newest wins. A stream whose frames stand refreshes them itself, first where fingers are: it gets the cells
when they change, and again as long as they are not shown. When the reader is gone, the cells are cleared. The end of
this process closes the stream, whose pulses the daemon drops.
"""

import os
import select
import sys
import time
from collections.abc import Callable
from typing import Protocol

from optodrive.client.cell_places import draw_cells
from optodrive.client.humanware import NAMED_KEYS
from optodrive.client.reader_channels import READ_BYTES, ReaderChannel
from optodrive.client.stream import Stream
from optodrive.core.errors import InputError
from optodrive.planning.stimuli.cell_slots import CellSlot

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
