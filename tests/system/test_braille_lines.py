"""Several lines of braille under an unmodified BRLTTY: cells in the executed pulses, keys, and rights."""

import random
import socket

import pytest

import braille_reader
from braille_desk import COUNT, ServedLines, draw_text, running_desk
from braille_reader import ROUTING_KEY
from forked_process import OPTODRIVE, run_process
from optodrive.client.reader_port import FIRST_PORT, HOST
from rig import wait_for
from shared_screen import SharedScreen

pytestmark = pytest.mark.skipif(
    not braille_reader.is_installed(), reason="BRLTTY is not installed: scripts/test-packages"
)
ROWS, COLUMNS = 5, 7
ROUTED_CELL = 10
"""From 0, on the second line."""


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lines")
    screen = SharedScreen(folder, 12, 30)
    with running_desk(folder, ServedLines) as desk:
        yield desk
    screen.close()


def dismiss_message(desk):
    """Press a key until it comes back, because the first one only ends BRLTTY's message. Return its code."""

    def pressed():
        desk.command.press(f"routing {ROUTED_CELL + 1}")
        return desk.writer.read_key()

    code = wait_for(pressed, "a key")
    desk.command.press("enter")
    wait_for(lambda: desk.writer.read_key() == 0xFF0D, "the keyboard's key")
    return code


def test_a_program_writes_all_lines_and_gets_the_keys(desk):
    rng = random.Random(1)
    assert desk.writer.count == ROWS * COLUMNS == COUNT
    for _ in range(2):
        since, expected = desk.show(draw_text(rng))
        before = len(desk.board.of("pulse"))
        wait_for(lambda before=before: len(desk.board.of("pulse")) > before + 20, "the frame again")
        assert desk.find_emitted(since) == expected
    assert dismiss_message(desk) == ROUTING_KEY | ROUTED_CELL


def test_a_client_without_the_key_neither_shows_nor_ends_what_is_shown(desk):
    number = int(desk.command.place.arguments[0])
    with socket.create_connection((HOST, FIRST_PORT + number)) as client:
        assert client.recv(100) == b"", "one client has it"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["x"], "PORT: got 'x', expected the number of a server of BrlAPI, 0 to 61434"),
        (["61435"], "PORT: got '61435', expected the number of a server of BrlAPI, 0 to 61434"),
        (
            ["1", "--key-file", "absent"],
            "--key-file: got 'absent', expected a file that can be read: No such file or directory",
        ),
        (["1", "--key-file", "/dev/null"], "--key-file: got '/dev/null', expected a file that is not empty"),
    ],
)
def test_a_wrong_place_is_one_line(tmp_path, arguments, message):
    command = [OPTODRIVE, "braille", "--protocol", "brlapi", *arguments]
    done = run_process(command, capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"optodrive: {message}\n")
