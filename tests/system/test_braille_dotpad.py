"""Lines of braille by the DotPad's protocol: cells in the executed pulses, keys, and the end of either side."""

import random

import pytest

from braille_desk import (
    COUNT,
    DotGraphic,
    DotGridLines,
    draw_text,
    running_desk,
)
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


@pytest.fixture(scope="module")
def graphic_desk(tmp_path_factory):
    with running_desk(tmp_path_factory.mktemp("graphic"), DotGraphic) as desk:
        yield desk


def test_text_and_graphics_light_their_dots_and_no_other(graphic_desk):
    rng = random.Random(4)
    for _ in range(2):
        since, expected = graphic_desk.show(rng.randbytes(graphic_desk.writer.count))
        assert graphic_desk.find_emitted(since) == expected
