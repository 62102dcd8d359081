"""ILDA files: their formats, palettes and blanking, against files written byte by byte after the standard."""

import struct

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.device.config import PixelLayout
from optodrive.planning.stimuli.drawings import compute_lattice_heights
from optodrive.planning.stimuli.ilda import convert_ilda
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.planning.stimuli.pixel_lattice import Lattice

PLACES = 8
RED, BLACK, BLANKED = (255, 0, 0), (0, 0, 0), 0x40
CORNERS = [(-28672, -28672), (28672, -28672), (28672, 28672)]
"""Middles of the places at the lower left, the lower right and the upper right of 8 × 8."""


def section(kind, records, projector=0, count=None):
    count = len(records) if count is None else count
    head = (
        b"ILDA" + bytes([0, 0, 0, kind]) + b"drawing " + b"a lab   " + struct.pack(">HHHBB", count, 0, 1, projector, 0)
    )
    return head + b"".join(records)


def point(kind, place, status=0, index=0, colour=RED):
    third = struct.pack(">h", 17) if kind in (0, 4) else b""
    shade = bytes([index]) if kind < 2 else bytes(reversed(colour))
    return struct.pack(">hh", *place) + third + bytes([status]) + shade


END = section(0, [])


def raised(file, picture=0):
    row, column = np.divmod(np.arange(PLACES * PLACES), PLACES)
    lattice = Lattice.from_layout("square", PixelLayout(column * 1e-3, row * 1e-3, row, column))
    svg = convert_ilda(file, "t")[picture]
    return {
        (int(c), int(r)) for r, c in np.argwhere(compute_lattice_heights(svg, lattice, "t").reshape(PLACES, PLACES))
    }


BOTTOM, RIGHT = {(k, 0) for k in range(PLACES)}, {(PLACES - 1, k) for k in range(PLACES)}


@pytest.mark.parametrize("kind", [0, 1, 4, 5])
def test_each_format_draws_from_point_to_point_and_blanked_moves_do_not(kind):
    first, second, third = CORNERS
    points = [point(kind, first, BLANKED), point(kind, second), point(kind, third, 0x80)]
    assert raised(section(kind, points) + END) == BOTTOM | RIGHT
    points[1] = point(kind, second, BLANKED)
    assert raised(section(kind, points) + END) == RIGHT
    assert raised(section(kind, points)) == RIGHT, "a file may end without an empty section"


@pytest.mark.parametrize("kind", [4, 5])
def test_black_is_dark(kind):
    points = [point(kind, CORNERS[0]), point(kind, CORNERS[1], colour=BLACK), point(kind, CORNERS[2])]
    assert raised(section(kind, points) + END) == RIGHT


def test_a_palette_says_which_indices_are_dark_from_there_on():
    points = [point(1, place, index=k) for k, place in enumerate(CORNERS)]
    palette = section(2, [bytes(RED), bytes(BLACK), bytes([0, 0, 1])])
    file = section(1, points) + palette + section(1, points) + END
    assert raised(file) == BOTTOM | RIGHT
    assert raised(file, 1) == RIGHT


def test_a_beam_that_rests_is_a_dot():
    assert raised(section(5, [point(5, CORNERS[2])]) + END) == {(7, 7)}
    assert raised(section(5, [point(5, CORNERS[0], BLANKED), *[point(5, CORNERS[2], s) for s in (BLANKED, 0)]])) == {
        (7, 7)
    }


def test_pictures_follow_each_other_and_a_dark_one_is_a_pause():
    line = section(5, [point(5, place) for place in CORNERS[:2]])
    dark = section(5, [point(5, CORNERS[0], BLANKED)])
    given = {"file": line + dark + line + END, "seconds": 0.2}
    frames = build_pattern("drawing", given, DISPLAYS["display-16"].config).frames
    starts = {frame.frame_id.rpartition("-")[0]: frame.show_at_s for frame in reversed(frames)}
    assert list(starts) == ["drawing-3", "drawing-1"]
    assert starts["drawing-1"] == 0.0
    assert starts["drawing-3"] >= 0.4
    alone = build_pattern("drawing", given | {"file": line}, DISPLAYS["display-16"].config).frames
    assert alone[0].frame_id == "drawing-0"


ONE = [point(1, CORNERS[0])]


@pytest.mark.parametrize(
    ("file", "message"),
    [
        (section(3, ONE), "section 1: got format 3, expected one of 0, 1, 2, 4, 5"),
        (section(1, ONE, count=2), "section 1: got 6 bytes for 2 records, expected 12"),
        (section(1, ONE) + b"ILDA", "section 2: got 4 bytes at its end, expected a header of 32"),
        (section(1, ONE) + bytes(32), r"section 2: got b'.*' at byte 38, expected ILDA"),
        (
            section(1, [point(1, CORNERS[0], index=64)]),
            "section 1: got colour 64, expected a colour of the palette, 0 to 63",
        ),
        (section(1, ONE) + section(1, ONE, 1), "section 2: got projector 1, expected projector 0 as above"),
        (END, "got an ILDA file without a picture, expected one with points"),
        (section(1, ONE) * 101, "got more than 100 pictures, expected fewer"),
        (section(1, [point(1, CORNERS[0], BLANKED)] * 3), "raises nothing|nothing"),
    ],
)
def test_what_it_cannot_show_is_refused_in_one_line(file, message):
    with pytest.raises(InputError, match=message) as caught:
        build_pattern("drawing", {"file": file}, DISPLAYS["display-16"].config)
    assert "\n" not in str(caught.value)


def test_random_bytes_are_refused_or_drawn():
    rng = np.random.default_rng(3)
    whole = (
        section(4, [point(4, place) for place in CORNERS])
        + section(2, [bytes(RED)])
        + section(0, [point(0, CORNERS[0])])
    )
    for _ in range(300):
        file = bytearray(whole[: rng.integers(4, len(whole) + 1)])
        file[int(rng.integers(4, max(5, len(file)))) % len(file)] = int(rng.integers(256))
        try:
            convert_ilda(bytes(file), "t")
        except InputError:
            continue
