"""A display divided into a line of text and a graphic display: whole cells, no dot in both, the lattice's pitch."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.client.cell_places import divide_display
from optodrive.core.errors import InputError
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config

SIZES = {"display-357": (6, 3, 9), "display-437": (6, 4, 10), "display-1511": (11, 8, 19)}
"""Cells of the line, lines and columns of graphic cells."""


def divide(name):
    layout = build_pixel_layout(load_config(name).display)
    return divide_display(layout, name), layout


@pytest.mark.parametrize("name", SIZES)
def test_areas_have_whole_cells_and_share_no_pixel(name):
    (text, graphic), _ = divide(name)
    assert (len(text), len(text[0]), len(graphic), len(graphic[0])) == (1, SIZES[name][0], *SIZES[name][1:])
    assert {len(line) for line in graphic} == {SIZES[name][2]}
    pixels = [pixel for line in text + graphic for slot in line for pixel in slot.values()]
    assert len(set(pixels)) == len(pixels)
    assert all(set(slot) == set(range(1, 7)) for slot in text[0])
    assert all(set(slot) == set(range(1, 9)) for line in graphic for slot in line)


@pytest.mark.parametrize("name", SIZES)
def test_graphic_dots_are_a_grid_of_the_display_s_pitch_below_the_text(name):
    (text, graphic), layout = divide(name)
    dots = [
        [pixel for slot in line for pixel in (slot[left], slot[left + 3])] for line in graphic for left in (1, 2, 3)
    ]
    lowest = [[pixel for slot in line for pixel in (slot[7], slot[8])] for line in graphic]
    grid = np.array([row for k in range(len(graphic)) for row in (*dots[3 * k : 3 * k + 3], lowest[k])])
    pitch_m = layout.x_m[grid[0, 1]] - layout.x_m[grid[0, 0]]
    assert np.diff(layout.x_m[grid], axis=1) == pytest.approx(pitch_m)
    assert np.diff(layout.y_m[grid], axis=0) == pytest.approx(-pitch_m)
    gap_m = min(layout.y_m[slot[3]] for slot in text[0]) - layout.y_m[grid[0, 0]]
    assert gap_m >= 1.9 * pitch_m  # an empty row between


@pytest.mark.parametrize("name", sorted(set(DISPLAYS) - set(SIZES)))
def test_a_small_display_is_refused_by_name(name):
    with pytest.raises(InputError, match=name):
        divide(name)
