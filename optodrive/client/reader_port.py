"""The serial port that a screen reader opens to write the cells of the display.

Theory of operation. A pseudo-terminal takes the place of the serial port of a braille display, whose cells are those
of the tactile display, line after line. Dots fall within a second without light, so all cells are streamed again every
FRAME_S while any dot is up, and of these frames the newest wins. This process closes the reader's end of the port: a
hang-up therefore means that no reader has it open, and the cells are cleared. The end of this process closes the
stream, whose pulses the daemon drops.
"""

import os
import select
import sys
import termios
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from optodrive.client.humanware import CELLS_MAX, FIRST_ROUTING_KEY, NAMED_KEYS, CellLine, build_key_press
from optodrive.client.stream import Stream
from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import PixelLayout
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.planning.stimuli.text import CellSlot, Spacing, find_line_slots

FRAME_S = 0.1
READ_BYTES = 4096
MISSING_READER_S = 0.05
"""Wait without a reader, whose absence ends each wait for its bytes at once."""
NOT_SHOWN = ("refused", "failed", "stopped")
"""Statuses of frames that were not shown, or not to their end, although no newer one came."""
SPACING = Spacing(dot_step=1, cell_gap=1, line_gap=1)


def find_cell_pixels(layout: PixelLayout, name: str) -> list[CellSlot]:
    """Return the pixel of each dot of each cell, line after line. Raise InputError if none fits the display."""
    slots = [slot for line in find_line_slots(Lattice.from_layout(name, layout), SPACING) for slot in line]
    if not slots:
        raise InputError("display", name, "room for a braille cell, 3 rows of 2 pixels", code="does_not_fit")
    return slots[:CELLS_MAX]


class ReaderPort:
    """The screen reader at the other end of a pseudo-terminal, and the keys of standard input.

    pixels: of each dot of each cell; report: takes a line on what was not shown or not understood
    """

    def __init__(
        self,
        terminal: int,
        line: CellLine,
        stream: Stream,
        pixels: list[CellSlot],
        height_um: float,
        pixel_count: int,
        report: Callable[[str], None],
    ) -> None:
        self._terminal, self._line, self._stream, self._report = terminal, line, stream, report
        self._pixels, self._height_um, self._pixel_count = pixels, height_um, pixel_count
        self._attributes = termios.tcgetattr(terminal)
        self._poll = select.poll()
        self._poll.register(terminal, select.POLLIN)
        self._poll.register(sys.stdin.fileno(), select.POLLIN)
        self._shown = bytes(line.count)
        self._problem, self._has_reader = "", False

    def run(self) -> None:
        """Run until an exception ends it."""
        due_s = time.monotonic()
        while True:
            self._take_input(max(0.0, due_s - time.monotonic()))
            is_due = time.monotonic() >= due_s
            if self._line.cells != self._shown or (is_due and any(self._shown)):
                self._show(self._line.cells)
            if is_due:
                due_s = time.monotonic() + FRAME_S

    def _take_input(self, wait_s: float) -> None:
        for source, events in self._poll.poll(1e3 * wait_s):
            if source == self._terminal and events & select.POLLIN:
                self._has_reader = True
                self._write(self._line.receive(os.read(self._terminal, READ_BYTES)))
            elif source == self._terminal:
                self._forget_reader()
                time.sleep(MISSING_READER_S)
            else:
                self._press(os.read(source, READ_BYTES))

    def _forget_reader(self) -> None:
        """Clear the cells, and restore the port's settings for the next reader.

        The C library refuses settings of which a pseudo-terminal takes none: those of a reader before it, with parity.
        """
        self._line.clear()
        self._has_reader = False
        termios.tcsetattr(self._terminal, termios.TCSANOW, self._attributes)

    def _press(self, text: bytes) -> None:
        """Press the keys of the lines of standard input. Without a reader, the next one would find them."""
        if not text:
            self._poll.unregister(sys.stdin.fileno())
        for name in text.decode(errors="replace").splitlines():
            try:
                keys = parse_key(name, self._line.count)
                if not self._has_reader:
                    raise InputError("key", name, "a reader that has opened the port")
                self._write(build_key_press(keys))
            except InputError as error:
                self._report(str(error))

    def _write(self, data: bytes) -> None:
        """Write to the reader. One that does not read loses the rest."""
        with suppress(BlockingIOError):
            os.write(self._terminal, data)

    def _show(self, cells: bytes) -> None:
        self._stream.send(draw_cells(cells, self._pixels, self._height_um, self._pixel_count))
        self._shown = cells
        for result in self._stream.results():
            if result.status in NOT_SHOWN:
                problem = result.error or (result.problem.detail if result.problem else result.status)
                if problem != self._problem:
                    self._report(f"not shown: {problem}")
                self._problem = problem
            elif result.executed:
                self._problem = ""


def draw_cells(cells: bytes, pixels: list[CellSlot], height_um: float, pixel_count: int) -> FloatArray:
    """Return the height of each pixel, µm, [p]. Dots 7 and 8 have no pixel."""
    heights_um = np.zeros(pixel_count)
    for dots, slot in zip(cells, pixels, strict=True):
        heights_um[[pixel for dot, pixel in slot.items() if dots >> (dot - 1) & 1]] = height_um
    return heights_um


def parse_key(text: str, cell_count: int) -> tuple[int, ...]:
    """Return the numbers of a key by its name, or of `routing N` for cell N. Raise InputError for another name."""
    name, _, number = text.strip().partition(" ")
    if name == "routing" and number.isdecimal() and 1 <= int(number) <= cell_count:
        return (FIRST_ROUTING_KEY + int(number) - 1,)
    if name in NAMED_KEYS and not number:
        return NAMED_KEYS[name]
    raise InputError("key", text, f"{', '.join(NAMED_KEYS)}, or routing 1 to {cell_count}")
