"""The server's side of BrlAPI's protocol without a socket: rights, writes by region and mask, and what it refuses."""

import random
import struct

import pytest

from optodrive.client.brlapi import NAMED_KEYS, CellPage

KEY = b"a key of sixteen"
VERSION, AUTH = struct.pack(">I", 8), struct.pack(">I", ord("K"))


def build(kind, data=b""):
    return struct.pack(">I4s", len(data), kind.rjust(4, b"\0")) + data


def read(answers):
    """Return the packets as pairs of type and data."""
    packets = []
    while answers:
        size, kind = struct.unpack_from(">I4s", answers)
        packets.append((kind.lstrip(b"\0"), answers[8 : 8 + size]))
        answers = answers[8 + size :]
    return packets


def build_write(cells, begin=1, size=None, text=None, shown=None):
    """Build a write of cells from place `begin` on, as BRLTTY's driver does; text: of four bytes per character."""
    flags = 0x02 | (0x44 if text else 0) | (0 if shown is None else 0x08) | 0x10 | 0x20
    data = struct.pack(">Iii", flags, begin, len(cells) if size is None else size)
    if text:
        data += struct.pack(">I", len(text)) + text
    data += b"" if shown is None else shown
    data += cells + struct.pack(">I", 0)
    return build(b"w", data + (b"\x08UCS-4LE " if text else b""))


@pytest.fixture
def page():
    page = CellPage(2, 3, KEY)
    page.receive(build(b"v", VERSION) + build(b"a", AUTH + KEY) + build(b"t", bytes(5)))
    return page


def test_a_client_proves_its_right_and_learns_the_size():
    page = CellPage(5, 7, KEY)
    assert read(page.greeting) == [(b"v", VERSION)]
    assert read(page.receive(build(b"v", VERSION))) == [(b"a", AUTH)]
    assert not page.has_reader
    assert read(page.receive(build(b"a", AUTH + KEY))) == [(b"A", b"")]
    assert page.has_reader
    assert read(page.receive(build(b"s"))) == [(b"s", struct.pack(">II", 7, 5))]
    assert read(page.receive(build(b"n") + build(b"Z"))) == [(b"n", b"optodrive\0"), (b"A", b"")]


@pytest.mark.parametrize("key", [b"", KEY[:-1], KEY + b"\n", b"another key 16 b"])
def test_without_the_key_nothing_is_shown(key):
    page = CellPage(2, 3, KEY)
    page.receive(build(b"v", VERSION))
    assert read(page.receive(build(b"a", AUTH + key))) == [(b"e", struct.pack(">II", 17, ord("a")))]
    answers = page.receive(build(b"t", bytes(5)) + build_write(b"\xff" * 6))
    assert read(answers) == [(b"e", struct.pack(">II", 17, ord("t"))), (b"E", struct.pack(">II", 17, ord("w")))]
    assert (page.cells, page.has_reader) == (bytes(6), False)


def test_cells_are_those_of_the_last_write_in_any_pieces(page):
    rng = random.Random(1)
    for _ in range(200):
        cells = rng.randbytes(6)
        text = None if rng.random() < 0.5 else bytes(24)
        data = build_write(rng.randbytes(6)) + build_write(cells, text=text, shown=bytes(6))
        while data:
            size = rng.randint(1, len(data))
            assert page.receive(data[:size]) == b""
            data = data[size:]
        assert page.cells == cells


def test_a_region_leaves_the_rest(page):
    page.receive(build_write(b"abcdef"))
    page.receive(build_write(b"XY", begin=3, size=-2))
    assert page.cells == b"abXYef"


@pytest.mark.parametrize(
    ("packet", "code"),
    [
        (build_write(b"abcdefg"), 7),
        (build_write(b"abc", begin=5), 7),
        (build_write(b"abc", begin=0), 7),
        (build_write(b"abc", size=4), 7),
        (build(b"w", b"abc"), 7),
        (build(b"w", struct.pack(">IiiI", 6, 1, 6, 1 << 31)), 7),
        (build_write(b"abcdef", text=bytes(24)), 9),  # text that shows, as no mask hides it
    ],
)
def test_a_wrong_write_is_an_exception_and_shows_nothing(page, packet, code):
    page.receive(build_write(b"before"))
    assert read(page.receive(packet)) == [(b"E", struct.pack(">II", code, ord("w")))]
    assert page.cells == b"before"


def test_a_write_of_nothing_and_the_end_of_the_display_clear_the_cells(page):
    page.receive(build_write(b"before") + build(b"w", bytes(4)))
    assert page.cells == bytes(6)
    page.receive(build_write(b"before") + build(b"L"))
    assert page.cells == bytes(6)
    assert read(page.receive(build_write(b"before"))) == [(b"E", struct.pack(">II", 5, ord("w")))]


@pytest.mark.parametrize("kind", [b"*", b"S", b"p", b"PR", b"\xff\xff\xff\xff"])
def test_what_is_not_offered_is_refused(page, kind):
    assert read(page.receive(build(kind))) == [(b"e", struct.pack(">I4s", 9, kind.rjust(4, b"\0")))]


def test_a_packet_that_is_too_long_is_refused_and_the_next_client_is_read(page):
    assert read(page.receive(struct.pack(">II", 4097, ord("w")))) == [(b"e", struct.pack(">II", 7, ord("w")))]
    page.clear()
    assert read(page.receive(build(b"v", VERSION))) == [(b"a", AUTH)]


def test_nonsense_raises_nothing(page):
    rng = random.Random(2)
    for _ in range(3000):
        page.receive(build(bytes([rng.choice(b"vasndtLwFmuZ*")]), rng.randbytes(rng.randint(0, 40))))
        assert len(page.cells) == 6


def test_keys_have_codes_of_their_own(page):
    presses = [page.build_key_press(name) for name in NAMED_KEYS] + [
        page.build_key_press("routing", k) for k in range(6)
    ]
    assert len(set(presses)) == len(presses)
    assert read(presses[-1]) == [(b"k", struct.pack(">Q", 0x2001_0005))]
