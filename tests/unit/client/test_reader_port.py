"""The port between a screen reader and the display, on a real pseudo-terminal, without a daemon."""

import os
import termios
import threading
import tty
from contextlib import suppress

import pytest

from optodrive.client.humanware import NAMED_KEYS, CellLine
from optodrive.client.reader_port import FRAME_S, ReaderPort, SerialChannel
from optodrive.daemon.responses.messages import FrameResult
from rig import wait_for

PIXELS = [{dot: dot - 1 for dot in range(1, 7)}]
INIT = b"\x1b\0\0"
REPLY = b"\x1b\1\3\0\x10\1"


class EndedError(Exception):
    """Ends the port's thread."""


class RecordedStream:
    """What the port shows."""

    def __init__(self):
        self.frames, self.ended, self.coming = [], False, []

    def send(self, heights_um):
        if self.ended:
            raise EndedError
        self.frames.append(heights_um.tolist())

    def results(self):
        coming, self.coming = self.coming, []
        return coming


class Desk:
    """A port of one cell in a thread, and the keys' end of its standard input."""

    def __init__(self, folder, monkeypatch):
        keys, self.keys = os.pipe()
        self.input = os.fdopen(keys)
        monkeypatch.setattr("sys.stdin", self.input)
        self.path, self.stream, self.reports = folder / "braille", RecordedStream(), []
        self.channel, self.line = SerialChannel(self.path), CellLine(1)
        (self.terminal,) = self.channel.list_descriptors()
        self.port = ReaderPort(self.channel, self.line, self.stream, PIXELS, 100.0, 6, self.reports.append)
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self):
        with suppress(EndedError):
            self.port.run()

    def open(self):
        """Open the port as BRLTTY does, with even parity. Return its descriptor."""
        reader = os.open(self.path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(reader, termios.TCSANOW)  # which leaves what has arrived
        attributes = termios.tcgetattr(reader)
        attributes[2] |= termios.PARENB
        attributes[4] = attributes[5] = termios.B115200
        termios.tcsetattr(reader, termios.TCSANOW, attributes)
        return reader

    def stop(self):
        self.stream.ended = True
        reader = os.open(self.path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(reader)
        os.write(reader, b"\x1b\2\1\x01")  # it shows something, and so ends
        self.thread.join()
        os.close(reader)
        self.channel.close()
        os.close(self.keys)
        self.input.close()


@pytest.fixture
def desk(tmp_path, monkeypatch):
    desk = Desk(tmp_path, monkeypatch)
    yield desk
    desk.stop()


def test_cells_are_shown_again_and_cleared_with_their_reader(desk):
    reader = desk.open()
    os.write(reader, INIT + b"\x1b\2\1\x05")
    wait_for(lambda: desk.stream.frames.count([100.0, 0.0, 100.0, 0.0, 0.0, 0.0]) > 2, "the cell again and again")
    os.close(reader)
    wait_for(lambda: desk.stream.frames[-1] == [0.0] * 6, "the cleared cell")
    assert desk.stream.frames.count([0.0] * 6) == 1
    assert FRAME_S > 0.0


def test_each_reader_may_ask_for_the_same_settings_and_gets_its_own_answer(desk):
    for _ in range(3):
        reader = desk.open()
        os.write(reader, INIT)
        assert os.read(reader, len(REPLY)) == REPLY
        os.close(reader)
        wait_for(lambda: termios.tcgetattr(desk.terminal)[5] != termios.B115200, "the settings before")


def test_keys_are_passed_on_and_wrong_ones_reported(desk):
    reader = desk.open()
    os.write(reader, INIT)
    os.read(reader, len(REPLY))
    os.write(desk.keys, b"next\nnxet\nrouting 1\n")
    assert os.read(reader, 8) == b"\x1b\5\1\x14\x1b\6\1\x14"
    assert os.read(reader, 8) == b"\x1b\5\1\x50\x1b\6\1\x50"
    assert desk.reports == [f"key: got 'nxet', expected {', '.join(NAMED_KEYS)}, or routing 1 to 1"]
    os.close(reader)


def test_keys_that_nobody_read_are_not_those_of_the_next_reader(desk):
    os.write(desk.keys, b"next\n")
    wait_for(lambda: desk.reports, "the key")
    assert desk.reports == ["key: got 'next', expected a reader that has opened the port"]
    reader = desk.open()
    os.write(reader, INIT)
    assert os.read(reader, len(REPLY)) == REPLY
    os.close(reader)


def test_only_frames_that_nothing_newer_replaced_are_reported_each_reason_once(desk):
    results = [
        FrameResult(frame=0, status="superseded", error="replaced by a newer plan"),
        FrameResult(frame=1, status="cancelled", error="cancelled"),
        FrameResult(frame=2, status="failed", error="the board is DISARMED"),
        FrameResult(frame=3, status="failed", error="the board is DISARMED"),
        FrameResult(frame=4, status="superseded", error="replaced by a newer plan", executed=3),
        FrameResult(frame=5, status="failed", error="the board is DISARMED"),
    ]
    desk.stream.coming = results
    reader = desk.open()
    os.write(reader, b"\x1b\2\1\x05")
    wait_for(lambda: len(desk.reports) == 2, "two reports")
    assert desk.reports == ["not shown: the board is DISARMED"] * 2
    os.close(reader)
