"""Wrapping, pages and placement of braille text."""

from itertools import pairwise

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.device.config_file import list_shipped_configs, load_config
from optodrive.planning.stimuli.braille import SPACE, encode_word
from optodrive.planning.stimuli.pixel_lattice import Lattice, Spacing, find_line_slots
from optodrive.planning.stimuli.text import build_text, wrap_words

CONFIG = load_config("display-437")


def picture(frame, config=CONFIG):
    """Return rows of # and blanks, from the top."""
    lattice = Lattice.from_config(config)
    raised = np.where(lattice.index >= 0, frame.target_m[lattice.index] > 0, False)[::-1]
    return ["".join("#" if dot else " " for dot in row).rstrip() for row in raised]


def test_words_are_placed_on_the_lattice():
    frame = build_text(CONFIG, "t", "hi you", 1e-4, 1.0).frames[0]
    assert picture(frame)[:5] == [
        "",
        "#   #    ## #  #",
        "## #      #  #",
        "         ## #  ##",
        "",
    ]
    assert frame.target_m.max() == 1e-4


def test_a_page_is_refreshed_until_its_time_ends():
    frames = build_text(CONFIG, "t", "hi", 1e-4, 2.0).frames
    assert frames[-1].show_at_s + frames[-1].duration_s >= 2.0
    assert frames[0].duration_s == pytest.approx(0.1)
    assert len(frames) == 20
    assert all(np.array_equal(frame.target_m, frames[0].target_m) for frame in frames)
    assert all(a.show_at_s + a.duration_s == pytest.approx(b.show_at_s) for a, b in pairwise(frames))


def test_text_too_long_for_a_page_continues_on_the_next():
    frames = build_text(CONFIG, "t", "one two three four five six seven eight nine ten", 1e-4, 0.0).frames
    assert [frame.frame_id for frame in frames] == ["page-1-0", "page-2-0"]
    assert picture(frames[0]) != picture(frames[1])
    assert all(a.show_at_s + a.duration_s <= b.show_at_s + 1e-9 for a, b in pairwise(frames))


def test_words_wrap_and_words_longer_than_a_row_are_split():
    cells = {letter: encode_word(letter)[0] for letter in "abcdefghi"}
    back = {cell: letter for letter, cell in cells.items()} | {SPACE: " "}

    def rows(text, widths):
        words = [[[cells[letter] for letter in word] for word in line.split()] for line in text.split("\n")]
        return ["".join(back[cell] for cell in row) for row in wrap_words(words, widths)]

    assert rows("ab cd ef", [5]) == ["ab cd", "ef"]
    assert rows("abcdefghi ab", [4]) == ["abcd", "efgh", "i ab"]
    assert rows("ab abcdefg", [4]) == ["ab", "abcd", "efg"]
    assert rows("ab\n\ncd", [5]) == ["ab", "", "cd"]
    assert rows("ab cd ef gh", [5, 2]) == ["ab cd", "ef", "gh"]
    assert rows("abcd", [4]) == ["abcd"]
    assert rows("abc", [1]) == ["a", "b", "c"]


@pytest.mark.parametrize("name", [name for name in list_shipped_configs() if name != "display-1"])
@pytest.mark.parametrize("spacing", [Spacing(1, 1, 1), Spacing(1, 0, 0), Spacing(1, 2, 3)])
def test_every_dot_has_a_pixel_of_its_own(name, spacing):
    lattice = Lattice.from_config(load_config(name))
    pixels = [pixel for line in find_line_slots(lattice, spacing) for slot in line for pixel in slot.values()]
    assert pixels
    assert len(set(pixels)) == len(pixels)
    assert min(pixels) >= 0


def test_lines_avoid_the_missing_corners():
    lengths = [
        len(line) for line in find_line_slots(Lattice.from_config(load_config("display-1511")), Spacing(1, 1, 1))
    ]
    assert lengths == [11, *[13] * 8, 11]
    assert [len(line) for line in find_line_slots(Lattice.from_config(CONFIG), Spacing(1, 1, 1))] == [7] * 5


def test_dots_are_arranged_as_in_a_cell():
    lattice = Lattice.from_config(CONFIG)
    slot = find_line_slots(lattice, Spacing(2, 1, 1))[0][0]
    x_m, y_m = lattice.layout.x_m, lattice.layout.y_m
    for left, right in ((1, 4), (2, 5), (3, 6)):
        assert x_m[slot[right]] - x_m[slot[left]] == pytest.approx(2 * 3.6e-3)
        assert y_m[slot[right]] == y_m[slot[left]]
    assert y_m[slot[1]] - y_m[slot[3]] == pytest.approx(4 * 3.6e-3)


@pytest.mark.parametrize("text", [" ", "\n\n"])
def test_blank_text_is_refused(text):
    with pytest.raises(InputError, match="raises nothing: it is blank"):
        build_text(CONFIG, "t", text, 1e-4, 1.0)


def test_a_display_too_small_for_a_cell_is_refused():
    with pytest.raises(InputError, match="display-1: got '1 × 1', expected a display with 3 × 2 pixels"):
        build_text(load_config("display-1"), "t", "a", 1e-4, 1.0)
    with pytest.raises(InputError, match="5 × 3 pixels"):
        build_text(load_config("display-16"), "t", "a", 1e-4, 1.0, dot_step=2)
