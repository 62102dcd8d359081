"""The protocol of a HumanWare display without a port, in any pieces and after any nonsense."""

import random
from itertools import pairwise

import pytest

from optodrive.client.cell_places import cut_rectangle, draw_cells, find_cell_lines, join_lines
from optodrive.client.humanware import CELLS_MAX, CellLine
from optodrive.client.reader_port import parse_key
from optodrive.core.errors import InputError
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config

INIT, GET_KEYS, GET_FIRMWARE, KEEP_AWAKE = (bytes([0x1B, kind, 0]) for kind in (0, 3, 12, 14))


def write_cells(cells):
    return bytes([0x1B, 2, len(cells)]) + cells


def test_a_reader_identifies_the_display():
    line = CellLine(35)
    assert line.receive(INIT) == bytes([0x1B, 1, 3, 0, 0x10, 35])
    assert line.receive(GET_FIRMWARE + GET_KEYS + KEEP_AWAKE) == bytes.fromhex("1b0d03010000 1b0400 1b0f00")


def test_cells_are_those_of_the_last_packet_in_any_pieces():
    rng = random.Random(1)
    line = CellLine(20)
    for _ in range(200):
        cells = rng.randbytes(20)
        data = write_cells(rng.randbytes(20)) + INIT + write_cells(cells)
        answers = b""
        while data:
            size = rng.randint(1, len(data))
            answers += line.receive(data[:size])
            data = data[size:]
        assert line.cells == cells
        assert answers == bytes([0x1B, 1, 3, 0, 0x10, 20])


@pytest.mark.parametrize("cells", [b"\x01", bytes(range(80))])
def test_cells_of_another_length_fill_the_line_or_are_cut(cells):
    line = CellLine(4)
    line.receive(write_cells(cells))
    assert line.cells == cells[:4].ljust(4, b"\0")


def test_nonsense_is_ignored():
    rng = random.Random(2)
    line = CellLine(4)
    for _ in range(2000):
        line.receive(rng.randbytes(rng.randint(0, 40)).replace(b"\x1b\x02", b""))
    line.receive(bytes(300))  # the rest of a packet that has begun
    assert line.receive(INIT) == bytes([0x1B, 1, 3, 0, 0x10, 4])


def test_a_packet_in_part_is_forgotten_with_its_reader():
    line = CellLine(4)
    line.receive(write_cells(b"\xff" * 4) + b"\x1b\x02\x04\x01")
    line.clear()
    assert line.cells == bytes(4)
    assert line.receive(INIT) == bytes([0x1B, 1, 3, 0, 0x10, 4])


def test_keys_of_a_chord_are_held_together():
    held, chord = set(), set()
    data = CellLine(4).build_key_press("cursor-up")
    for start in range(0, len(data), 4):
        _, kind, _, key = data[start : start + 4]
        held = held | {key} if kind == 5 else held - {key}
        chord = max(chord, held, key=len)
    assert (chord, held) == ({10, 2}, set())


@pytest.mark.parametrize(
    ("text", "key"), [("next", ("next", None)), ("routing 1", ("routing", 0)), (" routing 35\n", ("routing", 34))]
)
def test_keys_by_name(text, key):
    assert parse_key(text, 35) == key


@pytest.mark.parametrize("text", ["", "Next", "next 1", "routing", "routing 0", "routing 36", "routing x", "\x1b[2J"])
def test_another_key_is_one_line(text):
    with pytest.raises(
        InputError, match=r"key: got .*, expected previous, left, .*, enter, or routing 1 to 35"
    ) as raised:
        parse_key(text, 35)
    assert str(raised.value).isprintable()


@pytest.mark.parametrize(("name", "count"), [("display-437", 35), ("display-1511", CELLS_MAX), ("display-16", 1)])
def test_each_dot_of_each_cell_has_a_pixel_of_its_own(name, count):
    config = load_config(name)
    layout = build_pixel_layout(config.display)
    pixels = join_lines(find_cell_lines(layout, name))
    assert len(pixels) == count
    used = [pixel for slot in pixels for pixel in slot.values()]
    assert len(set(used)) == len(used) == 6 * count
    heights_um = draw_cells(bytes([0xC0 | 1 << (k % 6) for k in range(count)]), pixels, 150.0, len(layout))
    assert sorted(heights_um.nonzero()[0]) == sorted(slot[k % 6 + 1] for k, slot in enumerate(pixels))
    assert set(heights_um) == {0.0, 150.0}


def test_a_display_without_room_for_a_cell_is_one_line():
    layout = build_pixel_layout(load_config("display-1").display)
    with pytest.raises(InputError, match="display: got 'one', expected room for a braille cell"):
        find_cell_lines(layout, "one")


@pytest.mark.parametrize(
    ("name", "shape"), [("display-437", (5, 7)), ("display-1511", (10, 11)), ("display-16", (1, 1))]
)
def test_the_rectangle_of_cells_has_straight_columns_and_is_the_largest(name, shape):
    config = load_config(name)
    layout = build_pixel_layout(config.display)
    rows = cut_rectangle(find_cell_lines(layout, name), layout)
    assert (len(rows), {len(row) for row in rows}) == (shape[0], {shape[1]})
    columns = [[int(layout.column[slot[1]]) for slot in row] for row in rows]
    assert all(each == columns[0] for each in columns)
    tops = [int(layout.row[row[0][1]]) for row in rows]
    assert len({above - below for above, below in pairwise(tops)}) <= 1, "adjacent lines"
