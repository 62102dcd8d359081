"""`optodrive braille` under an unmodified BRLTTY: cells in the executed pulses, keys, and the end of either side."""

import os
import random
import signal
import subprocess
from contextlib import contextmanager

import numpy as np
import pytest

import braille_reader
from braille_reader import ROUTING_KEY, BrlttyProcess, Writer
from forked_process import OPTODRIVE, start_process
from optodrive.client.humanware import THUMB_KEYS
from optodrive.client.reader_port import draw_cells, find_cell_pixels
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config
from rig import TOKEN, running, wait_for
from test_six_experiments import cell_codes

pytestmark = pytest.mark.skipif(
    not braille_reader.is_installed(), reason="BRLTTY is not installed: scripts/test-packages"
)
LAYOUT = build_pixel_layout(load_config().display)
PIXELS = find_cell_pixels(LAYOUT, "display-437")
COUNT = len(PIXELS)


class BrailleCommand:
    """Process of `optodrive braille` on a daemon."""

    def __init__(self, folder, daemon):
        self.port, self.folder, self.daemon = folder / "braille", folder, daemon
        self.start()

    def start(self):
        environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "OPTODRIVE_URL": self.daemon.url}
        self.process = start_process(
            [OPTODRIVE, "braille", self.port],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout.readline() == f"{COUNT} cells at {self.port}; Ctrl-C ends it\n"

    def press(self, key):
        self.process.stdin.write(f"{key}\n")
        self.process.stdin.flush()

    def stop(self, number=signal.SIGKILL):
        self.process.send_signal(number)
        out, errors = self.process.communicate()
        return self.process.returncode, out, errors


class Desk:
    """A board, a daemon, `optodrive braille`, BRLTTY and a program that writes."""

    def __init__(self, folder, board, daemon):
        self.folder, self.board, self.daemon = folder, board, daemon
        self.command = BrailleCommand(folder, daemon)
        self.start_reader()

    def start_reader(self):
        self.reader = BrlttyProcess(self.folder, self.command.port)
        self.writer = Writer(self.reader)

    def stop(self):
        self.writer.close()
        self.reader.kill()
        self.command.stop()

    def find_emitted(self, since):
        """Return the pixels of the board's pulses from number `since` on."""
        codes = cell_codes()
        pulses = self.board.of("pulse")[since:]
        return {int(np.abs(codes - (pulse["x"], pulse["y"])).sum(axis=1).argmin()) for pulse in pulses}

    def show(self, cells):
        """Write cells, and wait until the board has emitted what they are, and since then nothing else."""
        expected = set(draw_cells(cells, PIXELS, 1.0, len(LAYOUT)).nonzero()[0].tolist())
        self.writer.write(cells)
        since = len(self.board.of("pulse"))

        def is_shown():
            nonlocal since
            if self.find_emitted(since) - expected:  # the rest of the cells before
                since = len(self.board.of("pulse"))
            return self.find_emitted(since) == expected and (expected or is_dark(self))

        wait_for(is_shown, f"{cells.hex()}, after pulse {since}")
        return since, expected


def is_dark(desk):
    """Return whether no plan waits or runs: the last frame has ended, and nothing is streamed any more."""
    state = desk.daemon.state()["board"]
    return state["state"] != "RUNNING" and not state["queued"]


@contextmanager
def running_desk(folder):
    with running(folder) as (board, daemon):
        daemon.arm()
        desk = Desk(folder, board, daemon)
        try:
            yield desk
        finally:
            desk.stop()


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    with running_desk(tmp_path_factory.mktemp("braille")) as desk:
        yield desk


def draw_text(rng):
    """Return random cells with some blank ones; dots 7 and 8 have no pixel."""
    return bytes(rng.choice([0, rng.randrange(256)]) for _ in range(COUNT))


@pytest.mark.parametrize("count", [2, pytest.param(60, marks=[pytest.mark.slow, pytest.mark.timeout(900)])])
def test_the_board_lights_the_dots_of_the_cells_and_no_other(desk, count):
    rng = random.Random(count)
    for _ in range(count):
        since, expected = desk.show(draw_text(rng))
        before = len(desk.board.of("pulse"))
        wait_for(lambda before=before: len(desk.board.of("pulse")) > before + 20, "the frame again")
        assert desk.find_emitted(since) == expected
    desk.show(bytes(COUNT))


def test_keys_come_back(desk):
    codes = []

    def presses(key):
        def pressed():
            desk.command.press(key)
            code = desk.writer.read_key()
            if code is not None:
                codes.append(code)
            return codes

        return pressed

    wait_for(presses("routing 7"), "a key: the first one ends BRLTTY's message")
    assert codes == [ROUTING_KEY | 6]
    while desk.writer.read_key() is not None:
        pass
    found = {}
    for key in THUMB_KEYS:
        desk.command.press(key)
        found[key] = wait_for(lambda: desk.writer.read_key(), f"{key} with its code")
    assert len(set(found.values())) == len(THUMB_KEYS)


def test_a_wrong_key_is_one_line(desk):
    desk.command.press("nxet")
    line = desk.command.process.stderr.readline()
    assert line.startswith("optodrive: key: got 'nxet', expected previous, left,")


def kill_reader(desk):
    desk.reader.kill()
    desk.writer.close()
    wait_for(lambda: is_dark(desk), "the dark after the reader")
    pulses = len(desk.board.of("pulse"))
    desk.start_reader()
    return pulses


def kill_command(desk):
    desk.command.stop()
    wait_for(lambda: is_dark(desk), "the dark after the command")
    pulses = len(desk.board.of("pulse"))
    assert desk.daemon.board_state() == "ARMED", "who armed it keeps it"
    desk.command.start()
    return pulses


@pytest.mark.parametrize("kill", [kill_reader, kill_command])
@pytest.mark.parametrize("count", [1, pytest.param(29, marks=[pytest.mark.slow, pytest.mark.timeout(900)])])
def test_a_side_that_is_killed_is_dark_until_it_is_back(tmp_path, kill, count):
    rng = random.Random(count)
    with running_desk(tmp_path) as desk:
        for _ in range(count):
            desk.show(draw_text(rng))
            kill(desk)
            since, expected = desk.show(draw_text(rng))
            assert desk.find_emitted(since) == expected
        assert not desk.board.of("fault")


def test_an_ended_command_leaves_no_port(tmp_path):
    with running(tmp_path) as (_, daemon):
        command = BrailleCommand(tmp_path, daemon)
        status, _, errors = command.stop(signal.SIGTERM)
        assert (status, errors) == (130, "optodrive: interrupted\n")
        assert not command.port.is_symlink()


def test_a_name_that_is_taken_is_one_line(tmp_path):
    taken = tmp_path / "file"
    taken.write_text("keep")
    done = subprocess.run([OPTODRIVE, "braille", "file"], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "optodrive: PORT: got 'file', expected a name that is free, or a link\n"
    assert taken.read_text() == "keep"


def test_without_a_daemon_one_line(tmp_path):
    done = subprocess.run(
        [OPTODRIVE, "braille", tmp_path / "tty", "--url", "http://127.0.0.1:9"], capture_output=True, text=True
    )
    assert done.returncode == 1
    assert done.stderr.startswith("optodrive: ")
    assert done.stderr.count("\n") == 1
