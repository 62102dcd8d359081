"""Texts by tables of liblouis that a program writes through an unmodified BRLTTY: cells, and executed pulses."""

import os
import select
import threading
from contextlib import suppress

import pytest

import braille_reader
from braille_desk import COUNT, SerialLine, running_desk
from braille_reader import BrlttyProcess, Writer, drive_serial
from liblouis_judge import ALPHABETS, draw_lines, judge
from optodrive.client.humanware import CELLS_MAX, CellLine
from optodrive.link.simulator.pseudo_terminal import open_pty
from rig import wait_for

pytestmark = pytest.mark.skipif(
    not braille_reader.is_installed(), reason="BRLTTY is not installed: scripts/test-packages"
)


class Line:
    """A line of cells on a pseudo-terminal, without a display."""

    def __init__(self, folder):
        self.port, self.line = folder / "braille", CellLine(CELLS_MAX)
        self._terminal, self._ended = open_pty(self.port), threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        while not self._ended.is_set():
            select.select([self._terminal], [], [], 0.05)
            with suppress(OSError):  # nothing, or no reader
                os.write(self._terminal, self.line.receive(os.read(self._terminal, 4096)))

    def stop(self):
        self._ended.set()
        self._thread.join()
        os.close(self._terminal)


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    line = Line(folder)
    reader = BrlttyProcess(folder, *drive_serial(line.port))
    writer = Writer(reader)
    yield line.line, writer
    writer.close()
    reader.kill()
    line.stop()


MANY = pytest.param(1000, marks=[pytest.mark.slow, pytest.mark.timeout(600)])


def list_cells(table, count, length):
    """Return pairs of a text and its cells by liblouis's own program, as many as a line of this length has."""
    for text, stated in judge(table, draw_lines(table, count)):
        cells = bytes(0 if character == " " else ord(character) - 0x2800 for character in stated)
        yield text, cells[:length].ljust(length, b"\0")


@pytest.mark.parametrize("count", [20, MANY])
@pytest.mark.parametrize("table", sorted(ALPHABETS))
def test_no_cell_is_wrong(desk, table, count):
    line, writer = desk
    for text, cells in list_cells(table, count, CELLS_MAX):
        writer.write(cells)
        wait_for(lambda cells=cells: line.cells == cells, f"{cells.hex()} of {text}")


class LowLine(SerialLine):
    """Dots so low that a line of them is drawn in a tenth of a second."""

    def __init__(self, folder):
        super().__init__(folder)
        self.arguments += ["--height-um", "20"]


TABLES = [
    pytest.param(sorted(ALPHABETS), 3, id="all"),
    *(
        pytest.param([table], 1000, id=table, marks=[pytest.mark.slow, pytest.mark.timeout(900)])
        for table in sorted(ALPHABETS)
    ),
]


@pytest.mark.parametrize(("tables", "count"), TABLES)
def test_no_executed_pulse_is_wrong(tmp_path, tables, count):
    with running_desk(tmp_path, LowLine) as desk:
        _, before = desk.show(b"\x01" * COUNT)  # after BRLTTY's message
        for text, cells in (each for table in tables for each in list_cells(table, count, COUNT)):
            desk.board.forget()
            since, expected = desk.show(cells)
            assert desk.find_emitted(since) == expected, text
            assert desk.find_emitted(0) <= before | expected, f"a dot of neither {text} nor the text before it"
            before = expected
