"""Lines of braille by the DotPad's protocol: cells in the executed pulses, keys, and the end of either side."""

import random
from itertools import pairwise
from statistics import median

import pytest

from braille_desk import (
    CELL_PLACES,
    COUNT,
    LAYOUT,
    DotGraphic,
    DotGridLines,
    draw_text,
    is_dark,
    pixel_at,
    running_desk,
)
from braille_reader import ROUTING_KEY, BrlttyProcess, Writer, drive_dots, has_driver
from dotpad_reader import list_held
from optodrive.client.dotpad import NAMED_KEYS
from rig import wait_for


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    with running_desk(tmp_path_factory.mktemp("dotpad"), DotGridLines) as desk:
        yield desk


def test_the_board_lights_the_dots_of_the_lines_and_no_other(desk):
    rng = random.Random(1)
    assert desk.writer.count == COUNT
    for _ in range(2):
        since, expected = desk.show(draw_text(rng))
        before = len(desk.board.of("pulse"))
        wait_for(lambda before=before: len(desk.board.of("pulse")) > before + 20, "the frame again")
        assert desk.find_emitted(since) == expected
    desk.show(bytes(COUNT))


def test_keys_come_back(desk):
    for name, keys in NAMED_KEYS.items():
        desk.command.press(name)
        assert list_held(desk.writer.take(0x0312)[2]) == set(keys)
        assert list_held(desk.writer.take(0x0312)[2]) == set()
    desk.command.press(f"routing {COUNT}")
    assert list_held(desk.writer.take(0x0322)[2]) == {COUNT - 1}
    assert list_held(desk.writer.take(0x0322)[2]) == set()


def test_a_side_that_is_killed_is_dark_until_it_is_back(desk):
    rng = random.Random(2)
    desk.show(draw_text(rng))
    desk.reader.kill()
    wait_for(lambda: is_dark(desk), "the dark after the reader")
    desk.start_reader()
    since, expected = desk.show(draw_text(rng))
    assert desk.find_emitted(since) == expected
    desk.command.stop()
    wait_for(lambda: is_dark(desk), "the dark after the command")
    desk.reader.kill()
    desk.command.start()
    desk.start_reader()
    since, expected = desk.show(draw_text(rng))
    assert desk.find_emitted(since) == expected
    assert not desk.board.of("fault")


@pytest.fixture(scope="module")
def graphic_desk(tmp_path_factory):
    with running_desk(tmp_path_factory.mktemp("graphic"), DotGraphic) as desk:
        yield desk


def test_text_and_graphics_light_their_dots_and_no_other(graphic_desk):
    rng = random.Random(4)
    for _ in range(2):
        since, expected = graphic_desk.show(rng.randbytes(graphic_desk.writer.count))
        assert graphic_desk.find_emitted(since) == expected


def test_the_time_of_each_display_is_that_of_its_pulses(graphic_desk):
    board = graphic_desk.writer.board
    assert board[:7] + board[8:11] == bytes([0xFC, 1, 36, 0, 1, 6, 0, 4, 10, 0])
    since, _ = graphic_desk.show(b"\xff" * graphic_desk.writer.count)
    ends_us = [pulse["off_us"] for pulse in graphic_desk.board.of("pulse")[since:]]
    period_s = median(later - end for end, later in pairwise(ends_us)) / 1e6
    assert [board[7], board[11]] == pytest.approx([36 * period_s / 0.1, 320 * period_s / 0.1], rel=0.1, abs=1)


class BrlttyLines(DotGridLines):
    def connect(self, folder):
        reader = BrlttyProcess(folder, *drive_dots(self.port))
        return reader, Writer(reader)


@pytest.mark.skipif(not has_driver("dp"), reason="needs a BRLTTY with a driver of the DotPad: 6.6 or later")
def test_brltty_drives_all_lines(tmp_path):
    rng = random.Random(3)
    with running_desk(tmp_path, BrlttyLines) as desk:
        assert desk.writer.count == COUNT
        for _ in range(3):
            since, expected = desk.show(draw_text(rng))
            assert desk.find_emitted(since) == expected

        def pressed():
            desk.command.press(f"routing {COUNT}")
            return desk.writer.read_key()

        assert wait_for(pressed, "a key: the first one ends BRLTTY's message") == ROUTING_KEY | (COUNT - 1)
        desk.command.press("enter")
        wait_for(lambda: desk.writer.read_key() == 0xFF0D, "the end of the routing keys")
        found = {}
        for key in NAMED_KEYS:
            desk.command.press(key)
            found[key] = wait_for(lambda: desk.writer.read_key(), f"{key} with its code")
        assert len(set(found.values())) == len(NAMED_KEYS)
        desk.reader.kill()
        desk.writer.close()
        wait_for(lambda: is_dark(desk), "the dark after the reader")
        desk.start_reader()
        since, expected = desk.show(draw_text(rng))
        assert desk.find_emitted(since) == expected


class BrlttyGraphic(DotGraphic):
    connect = BrlttyLines.connect


def find_drawn(desk, since):
    """Return the pixels of the graphic display emitted twice. BRLTTY writes its status to the line of text."""
    return {pixel for pixel, count in desk.count_emitted(since).items() if count >= 2 and LAYOUT.row[pixel] < 18}


@pytest.mark.skipif(not has_driver("dp"), reason="needs a BRLTTY with a driver of the DotPad: 6.6 or later")
def test_brltty_draws_on_the_graphic_display(tmp_path):
    """It draws 3 lines of 7 cells, with an empty column between cells and two empty rows between lines."""
    rng = random.Random(5)
    with running_desk(tmp_path, BrlttyGraphic) as desk:
        assert desk.writer.count == 21
        for _ in range(3):
            cells = rng.randbytes(21)
            expected = {
                pixel_at(4 + 6 * (number // 7) + down, 3 * (number % 7) + right)
                for number, dots in enumerate(cells)
                for dot, (down, right) in enumerate(CELL_PLACES)
                if dots >> dot & 1
            }
            desk.writer.write(cells)
            since = len(desk.board.of("pulse"))

            def is_drawn(expected=expected):
                nonlocal since
                if find_drawn(desk, since) - expected:  # the rest of the cells before
                    since = len(desk.board.of("pulse"))
                return find_drawn(desk, since) == expected

            wait_for(is_drawn, f"{cells.hex()}, after pulse {since}")
