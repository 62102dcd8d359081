"""The DotPad's protocol without a port: packets as BRLTTY's and NVDA's drivers write and read them."""

import random

import pytest

from dotpad_reader import BOARD, FIRMWARE, LINE, NAME, build, encode, list_held, read
from optodrive.client.dotpad import CellArea, CellGrid


@pytest.fixture
def grid():
    return CellGrid(CellArea(5, 7, 1.82), CellArea(0, 0, 0.0), 0.0036)


def test_a_packet_is_that_of_the_drivers():
    assert build(BOARD) == bytes.fromhex("aa55 0005 00 0110 00 b4")


def test_a_reader_learns_the_board_with_lengths_as_its_driver_expects(grid):
    (board, name, firmware) = read(grid.receive(build(BOARD) + build(NAME) + build(FIRMWARE)))
    features = 0x40 | 0x20 | 0x10 | 0x08 | 0x04
    assert board == (0x0111, 0, bytes([features, 1, 36, 0, 5, 7, 0, 19, 0, 0, 0, 0]))
    assert name == (0x0101, 0, b"optodrive ")
    assert firmware[:2] == (0x0001, 0)
    assert len(firmware[2]) == 8


@pytest.mark.parametrize("is_text", [False, True])
def test_lines_are_those_of_the_last_packets_in_any_pieces(grid, is_text):
    rng = random.Random(1)
    for _ in range(100):
        cells = rng.randbytes(35)
        lines = [cells[7 * line : 7 * line + 7] for line in range(5)]
        data = b"".join(
            build(LINE, b"\0" + (line if is_text else encode(line)), number, 0x80 * is_text)
            for number, line in enumerate(lines)
        )
        answers = b""
        while data:
            size = rng.randint(1, len(data))
            answers += grid.receive(data[:size])
            data = data[size:]
        assert grid.cells == cells
        assert read(answers) == [(code, line, b"\0") for line in range(5) for code in (0x0201, 0x0202)]


def test_cells_from_a_place_on_leave_the_others(grid):
    grid.receive(build(LINE, b"\0" + encode(range(1, 8)), 2))
    grid.receive(build(LINE, b"\5" + encode(b"\x81\x42"), 2))
    assert grid.cells == bytes(14) + bytes([1, 2, 3, 4, 5, 0x81, 0x42]) + bytes(14)


def test_a_write_of_no_cells_is_acknowledged(grid):
    grid.receive(build(LINE, b"\0" + b"\xff" * 7))
    before = grid.cells
    assert read(grid.receive(build(LINE, b"\0"))) == [(0x0201, 0, b"\0"), (0x0202, 0, b"\0")]
    assert grid.cells == before


@pytest.mark.parametrize(
    ("line", "data"), [(5, b"\0\xff"), (255, b"\0\xff"), (0, b"\1" + b"\xff" * 7), (4, b"\7\xff"), (0, b"")]
)
def test_cells_outside_are_refused(grid, line, data):
    assert read(grid.receive(build(LINE, data, line))) == [(0x0201, line, b"\1")]
    assert grid.cells == bytes(35)


def test_a_wrong_checksum_shows_nothing_and_names_itself(grid):
    packet = bytearray(build(LINE, b"\0" + b"\xff" * 7, 3))
    for place in range(4, len(packet)):
        changed = bytes(byte ^ (0x10 * (k == place)) for k, byte in enumerate(packet))
        answers = read(grid.receive(changed))
        assert answers in ([(0x0201, changed[4], b"\3")], [(0x9902, 0, b"\3")])
    assert grid.cells == bytes(35)


@pytest.mark.parametrize(
    ("packet", "code"),
    [(build(0x0210, b"\0"), 2), (build(0x0111), 2), (b"\xaa\x55\0\4\0\1\x10\0", 1), (b"\xaa\x55\xff\xff", 1)],
)
def test_what_is_not_offered_is_an_error(grid, packet, code):
    assert read(grid.receive(packet)) == [(0x9902, 0, bytes([code]))]
    assert read(grid.receive(build(NAME)))[0][0] == 0x0101


def test_nonsense_is_ignored(grid):
    rng = random.Random(2)
    for _ in range(2000):
        grid.receive(rng.randbytes(rng.randint(0, 40)).replace(b"\xaa\x55", b""))
    grid.receive(bytes(600))  # the rest of a packet that has begun
    assert read(grid.receive(build(NAME))) == [(0x0101, 0, b"optodrive ")]
    assert grid.cells == bytes(35)


def test_a_packet_in_part_is_forgotten_with_its_reader(grid):
    whole = build(LINE, b"\0" + b"\xff" * 7)
    grid.receive(whole + whole[:7])
    grid.clear()
    assert (grid.cells, grid.has_reader) == (bytes(35), False)
    assert read(grid.receive(build(NAME)))[0][0] == 0x0101


@pytest.mark.parametrize(
    ("name", "keys"),
    [("previous", {17}), ("left", {13}), ("right", {14}), ("next", {19}), ("home", {16}), ("cursor-up", {8, 3})],
)
def test_a_key_is_held_and_released(grid, name, keys):
    (held, released) = read(grid.build_key_press(name))
    assert (held[0], len(held[2]), list_held(held[2])) == (0x0312, 4, keys)
    assert released == (0x0312, 0, bytes(4))


def test_routing_keys_are_as_many_as_the_packet_has_room_for():
    large = CellGrid(CellArea(10, 11, 5.73), CellArea(0, 0, 0.0), 0.004)
    assert (large.count, large.routing_count) == (110, 64)
    for cell in range(64):
        (held, released) = read(large.build_key_press("routing", cell))
        assert (held[0], len(held[2]), list_held(held[2])) == (0x0322, 8, {cell})
        assert released == (0x0322, 0, bytes(8))


@pytest.fixture
def graphic_grid():
    return CellGrid(CellArea(1, 6, 0.31), CellArea(4, 10, 100.0), 0.0036)


def test_a_graphic_display_is_declared_beside_that_of_text(graphic_grid):
    ((_, _, board),) = read(graphic_grid.receive(build(BOARD)))
    features = 0x80 | 0x40 | 0x20 | 0x10 | 0x08 | 0x04
    assert board == bytes([features, 1, 36, 0, 1, 6, 0, 4, 4, 10, 0, 255])  # 25.5 s is the largest time


@pytest.mark.parametrize("graphic_flag", [0, 0x80])
def test_graphic_lines_follow_those_of_text(graphic_grid, graphic_flag):
    cells = random.Random(3).randbytes(46)
    graphic_grid.receive(build(LINE, b"\0" + cells[:6], 0, 0x80))
    for line in range(4):
        part = cells[6 + 10 * line :][:10]
        data = part if graphic_flag else encode(part)
        answers = graphic_grid.receive(build(LINE, b"\0" + data, 1 + line, graphic_flag))
        assert read(answers) == [(code, 1 + line, b"\0") for code in (0x0201, 0x0202)]
    assert graphic_grid.cells == cells
    graphic_grid.receive(build(LINE, b"\3" + encode(b"\xaa"), 2))  # a changed cell only
    assert graphic_grid.cells == cells[:19] + b"\xaa" + cells[20:]


@pytest.mark.parametrize(("line", "data"), [(0, bytes(8)), (1, bytes(12)), (4, b"\x09\0\0"), (5, bytes(2))])
def test_cells_outside_of_either_display_are_refused(graphic_grid, line, data):
    assert read(graphic_grid.receive(build(LINE, data, line))) == [(0x0201, line, b"\1")]
