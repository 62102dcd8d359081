"""`optodrive braille` under an unmodified BRLTTY: cells in the executed pulses, keys, and the end of either side."""

import random
import signal

import pytest

import braille_reader
from braille_desk import COUNT, BrailleCommand, SerialLine, draw_text, is_dark, running_desk
from braille_reader import ROUTING_KEY
from forked_process import OPTODRIVE, run_process
from optodrive.client.humanware import NAMED_KEYS
from rig import running, wait_for

pytestmark = pytest.mark.skipif(
    not braille_reader.is_installed(), reason="BRLTTY is not installed: scripts/test-packages"
)

KEYBOARD = {"cursor-left": 0xFF51, "cursor-up": 0xFF52, "cursor-right": 0xFF53, "cursor-down": 0xFF54, "enter": 0xFF0D}
"""Codes of BrlAPI, which are X11's."""

MOMENTS = 400
"""Numbers of pulses, some three frames, of which one is a random moment after text was written."""


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    with running_desk(tmp_path_factory.mktemp("braille")) as desk:
        yield desk


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
    desk.command.press("enter")
    wait_for(lambda: desk.writer.read_key() == KEYBOARD["enter"], "the end of the routing keys")
    found = {}
    for key in NAMED_KEYS:
        desk.command.press(key)
        found[key] = wait_for(lambda: desk.writer.read_key(), f"{key} with its code")
    assert len(set(found.values())) == len(NAMED_KEYS)
    assert {key: code for key, code in found.items() if key in KEYBOARD} == KEYBOARD


def test_a_wrong_key_is_one_line(desk):
    desk.command.press("nxet")
    line = desk.command.process.stderr.readline()
    assert line.startswith("optodrive: key: got 'nxet', expected previous, left,")


def kill_reader(desk):
    desk.reader.kill()
    desk.writer.close()
    wait_for(lambda: is_dark(desk), "the dark after the reader")
    desk.start_reader()


def kill_command(desk):
    desk.command.stop()
    wait_for(lambda: is_dark(desk), "the dark after the command")
    assert desk.daemon.board_state() == "ARMED", "who armed it keeps it"
    desk.command.start()


@pytest.mark.parametrize("kill", [kill_reader, kill_command])
@pytest.mark.parametrize("count", [1, pytest.param(30, marks=[pytest.mark.slow, pytest.mark.timeout(900)])])
def test_a_side_that_is_killed_is_dark_until_it_is_back(tmp_path, kill, count):
    rng = random.Random(count)
    with running_desk(tmp_path) as desk:
        for _ in range(count):
            desk.show(draw_text(rng))
            moment = len(desk.board.of("pulse")) + rng.randrange(MOMENTS)
            desk.writer.write(draw_text(rng))
            wait_for(lambda moment=moment: len(desk.board.of("pulse")) >= moment, "the moment")
            kill(desk)
            since, expected = desk.show(draw_text(rng))
            assert desk.find_emitted(since) == expected
        assert not desk.board.of("fault")


def test_an_ended_command_leaves_no_port(tmp_path):
    with running(tmp_path) as (_, daemon):
        command = BrailleCommand(SerialLine(tmp_path), daemon)
        status, _, errors = command.stop(signal.SIGTERM)
        assert (status, errors) == (130, "optodrive: interrupted\n")
        assert not command.place.port.is_symlink()


def test_a_name_that_is_taken_is_one_line(tmp_path):
    taken = tmp_path / "file"
    taken.write_text("keep")
    done = run_process([OPTODRIVE, "braille", "file"], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "optodrive: PORT: got 'file', expected a name that is free, or a link\n"
    assert taken.read_text() == "keep"


def test_without_a_daemon_one_line(tmp_path):
    done = run_process(
        [OPTODRIVE, "braille", tmp_path / "tty", "--url", "http://127.0.0.1:9"], capture_output=True, text=True
    )
    assert done.returncode == 1
    assert done.stderr.startswith("optodrive: ")
    assert done.stderr.count("\n") == 1
