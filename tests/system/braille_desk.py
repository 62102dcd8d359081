"""A desk of `optodrive braille`: board, daemon, command, BRLTTY, and a program that writes through it."""

import os
import signal
import socket
import subprocess
from collections import Counter
from contextlib import contextmanager

import numpy as np

from braille_reader import BrlttyProcess, Writer, drive_lines, drive_serial
from dotpad_reader import DotPadReader
from forked_process import OPTODRIVE, start_process
from optodrive.client.cell_places import draw_cells, find_cell_lines, join_lines
from optodrive.client.reader_port import FIRST_PORT, HOST
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config
from rig import TOKEN, running, wait_for
from test_six_experiments import cell_codes

LAYOUT = build_pixel_layout(load_config().display)
PIXELS = join_lines(find_cell_lines(LAYOUT, "display-437"))
COUNT = len(PIXELS)


def find_raised(cells, pixels=PIXELS):
    """Return the pixels of the raised dots."""
    return set(draw_cells(cells, pixels, 1.0, len(LAYOUT)).nonzero()[0].tolist())


class SerialLine:
    """One line of cells at a serial port: arguments of the command, what it prints, and its reader."""

    find_raised = staticmethod(find_raised)

    def __init__(self, folder):
        self.port = folder / "braille"
        self.arguments = [self.port]
        self.opened = f"{COUNT} cells at {self.port}"

    def connect(self, folder):
        """Start a reader. Return it, and a program that writes through it."""
        reader = BrlttyProcess(folder, *drive_serial(self.port))
        return reader, Writer(reader)


class ServedLines(SerialLine):
    """Several lines at a server of BrlAPI, as SerialLine."""

    def __init__(self, folder):
        key_file = folder / "key"
        key_file.write_bytes(os.urandom(20))
        with socket.create_server((HOST, 0)) as free:
            number = free.getsockname()[1] - FIRST_PORT
        self.arguments = [str(number), "--protocol", "brlapi", "--key-file", key_file]
        self.opened = f"5 lines of 7 cells at {HOST}:{number}"

    def connect(self, folder):
        number, *_, key_file = self.arguments
        reader = BrlttyProcess(folder, *drive_lines(number, key_file))
        return reader, Writer(reader)


class DotGridLines(SerialLine):
    """Several lines at a serial port by the DotPad's protocol, as SerialLine."""

    def __init__(self, folder):
        self.port = folder / "braille"
        self.arguments = [self.port, "--protocol", "dotpad"]
        self.opened = f"5 lines of 7 cells at {self.port}"

    def connect(self, folder):
        reader = DotPadReader(self.port)
        return reader, reader


class DotGraphic(DotGridLines):
    """A line of text above a graphic display, by the DotPad's protocol."""

    def __init__(self, folder):
        super().__init__(folder)
        self.arguments = [self.port, "--protocol", "dotpad-graphic"]
        self.opened = f"6 cells, 16 rows of 20 dots at {self.port}"

    @staticmethod
    def find_raised(cells):
        """Return the pixels of the raised dots: of 6 cells in rows 0 to 2, and of 4 × 10 without gaps from row 4 on."""
        raised = set()
        for number, dots in enumerate(cells):
            line, column = divmod(number - 6, 10)
            top, left = (0, 3 * number + 3) if number < 6 else (4 + 4 * line, 2 * column)
            places = CELL_PLACES if number >= 6 else CELL_PLACES[:6]
            raised |= {
                pixel_at(top + down, left + right) for dot, (down, right) in enumerate(places) if dots >> dot & 1
            }
        return raised


CELL_PLACES = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (3, 0), (3, 1)]
"""Rows down and columns right of the dots 1 to 8."""


def pixel_at(from_top, column):
    """Return the pixel at a place of the lattice of 21 rows."""
    (found,) = np.flatnonzero((LAYOUT.row == 20 - from_top) & (LAYOUT.column == column))
    return int(found)


class BrailleCommand:
    """Process of `optodrive braille` on a daemon."""

    def __init__(self, place, daemon):
        self.place, self.daemon = place, daemon
        self.start()

    def start(self):
        environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "OPTODRIVE_URL": self.daemon.url}
        self.process = start_process(
            [OPTODRIVE, "braille", *self.place.arguments],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout.readline() == f"{self.place.opened}; Ctrl-C ends it\n"

    def press(self, key):
        self.process.stdin.write(f"{key}\n")
        self.process.stdin.flush()

    def stop(self, number=signal.SIGKILL):
        self.process.send_signal(number)
        out, errors = self.process.communicate()
        return self.process.returncode, out, errors


class Desk:
    """A board, a daemon, `optodrive braille`, BRLTTY and a program that writes."""

    def __init__(self, folder, board, daemon, kind):
        self.folder, self.board, self.daemon = folder, board, daemon
        self.command = BrailleCommand(kind(folder), daemon)
        self.start_reader()

    def start_reader(self):
        self.reader, self.writer = self.command.place.connect(self.folder)

    def stop(self):
        self.writer.close()
        self.reader.kill()
        self.command.stop()

    def find_emitted(self, since):
        """Return the pixels that have pulses from pulse number `since` on."""
        return set(self.count_emitted(since))

    def count_emitted(self, since):
        """Return the number of pulses of each pixel from pulse number `since` on."""
        codes = cell_codes()
        pulses = self.board.of("pulse")[since:]
        return Counter(int(np.abs(codes - (pulse["x"], pulse["y"])).sum(axis=1).argmin()) for pulse in pulses)

    def wait_for_light(self, cells):
        """Wait until the board emits a pulse that these cells have."""
        expected = self.command.place.find_raised(cells)
        since = len(self.board.of("pulse"))
        wait_for(lambda: self.find_emitted(since) & expected, "light")

    def show(self, cells):
        """Write cells, and wait until the board has emitted what they are, and since then nothing else.

        Each dot twice: the rest of a frame before may consist of these dots, too.
        """
        expected = self.command.place.find_raised(cells)
        self.writer.write(cells)
        since = len(self.board.of("pulse"))

        def is_shown():
            nonlocal since
            counts = self.count_emitted(since)
            if counts.keys() - expected:  # the rest of the cells before
                since += counts.total()
                return False
            return counts.keys() == expected and (min(counts.values()) >= 2 if expected else is_dark(self))

        try:
            wait_for(is_shown, f"{cells.hex()}, after pulse {since}")
        except BaseException:
            self._describe(since, expected)
            raise
        return since, expected

    def _describe(self, since, expected):
        """Print what the parts do, for a report of a failure."""
        found, state = self.find_emitted(since), self.daemon.state()
        print(f"{len(found & expected)} of {len(expected)} dots, {len(found - expected)} others since pulse {since}")
        print(f"{len(self.board.of('pulse'))} pulses, command: {self.command.process.poll()}, board: {state['board']}")
        print(f"queue: {state['queue']}")


def is_dark(desk):
    """Return whether no plan waits or runs, nor holds for points: the last frame has ended, and none is streamed."""
    state = desk.daemon.state()["board"]
    return state["state"] in ("ARMED", "DISARMED") and not state["queued"]


@contextmanager
def running_desk(folder, kind=SerialLine):
    with running(folder) as (board, daemon):
        daemon.arm()
        desk = Desk(folder, board, daemon, kind)
        try:
            yield desk
        finally:
            desk.stop()


def draw_text(rng):
    """Return random cells with some blank ones; dots 7 and 8 have no pixel."""
    return bytes(rng.choice([0, rng.randrange(256)]) for _ in range(COUNT))
