"""Places of a screen reader's cells on a display: each cell as the pixels of its dots."""

import numpy as np

from optodrive.client.display import Display
from optodrive.client.dotpad import CellArea
from optodrive.client.humanware import CELLS_MAX
from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.device.config import PixelLayout
from optodrive.planning.stimuli.pixel_lattice import CellSlot, Lattice, Spacing, find_line_slots

SPACING = Spacing(dot_step=1, cell_gap=1, line_gap=1)
LINE_ROWS = 4
"""Rows of the lattice that a line of text takes, with the empty one below it."""
GRAPHIC_CELL = np.array([[1, 4], [2, 5], [3, 6], [7, 8]])
"""Dot of each place of a cell of a graphic display, whose cells have no gaps."""
PLANNED_S = 1.0
"""Duration of the frame whose plan is asked for. A frame that takes longer is planned to its end."""


def find_cell_lines(layout: PixelLayout, name: str) -> list[list[CellSlot]]:
    """Return the pixel of each dot of each cell, per line. Raise InputError if none fits the display."""
    lines = find_line_slots(Lattice.from_layout(name, layout), SPACING)
    if not lines:
        raise InputError("display", name, "room for a braille cell, 3 rows of 2 pixels", code="does_not_fit")
    return lines


def join_lines(lines: list[list[CellSlot]]) -> list[CellSlot]:
    """Return the cells of all lines as one line, as many as its protocol states."""
    return [slot for line in lines for slot in line][:CELLS_MAX]


def cut_rectangle(lines: list[list[CellSlot]], layout: PixelLayout) -> list[list[CellSlot]]:
    """Return the largest rectangle of cells: adjacent lines, of each the cells in columns that all of them have."""
    places = [{int(layout.column[slot[1]]): slot for slot in line} for line in lines]
    spans = [places[begin:end] for begin in range(len(places)) for end in range(begin + 1, len(places) + 1)]
    rectangles = []
    for span in spans:
        columns = sorted(set.intersection(*(set(line) for line in span)))
        rectangles.append([[line[column] for column in columns] for line in span])
    return max(rectangles, key=lambda rectangle: sum(map(len, rectangle)))


def divide_display(layout: PixelLayout, name: str) -> tuple[list[list[CellSlot]], list[list[CellSlot]]]:
    """Return the cells of a line of text at the top, and below it those of a graphic display.

    Dots of the graphic display have the lattice's pitch in both directions. Raises InputError if it has no room.
    """
    index = Lattice.from_layout(name, layout).index
    text = find_line_slots(Lattice(name, index[-LINE_ROWS + 1 :], layout), SPACING)
    lines = _find_graphic_lines(index[:-LINE_ROWS])
    graphic = cut_rectangle(lines, layout) if lines else []
    if not (text and graphic and graphic[0]):
        raise InputError("display", name, "room for a braille cell above a graphic one of 4 rows", code="does_not_fit")
    return text, graphic


def _find_graphic_lines(index: IntArray) -> list[list[CellSlot]]:
    """Return the cells that have all their pixels, per line from the top. index: [rows, columns], from the bottom."""
    height, width = GRAPHIC_CELL.shape
    rows, columns = index.shape[0] // height, index.shape[1] // width
    top, left = (index.shape[0] - rows * height) // 2, (index.shape[1] - columns * width) // 2
    inner = index[::-1][top : top + rows * height, left : left + columns * width]
    blocks = inner.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(rows, columns, height * width).tolist()
    dots = GRAPHIC_CELL.ravel().tolist()
    lines = [[dict(zip(dots, cell, strict=True)) for cell in line if min(cell) >= 0] for line in blocks]
    return [line for line in lines if line]


def plan_area(display: Display, lines: list[list[CellSlot]], height_um: float) -> CellArea:
    """Return the area of lines with the time in which the planner raises all of their dots. No lines: an empty area."""
    pixels = [pixel for line in lines for slot in line for pixel in slot.values()]
    if not pixels:
        return CellArea(0, 0, 0.0)
    plan = display.show(dict.fromkeys(pixels, height_um), PLANNED_S, dry_run=True)
    return CellArea(len(lines), len(lines[0]), plan.summary.duration_s)


def compute_pitch_m(layout: PixelLayout, slot: CellSlot) -> float:
    """Return the distance between the dots 1 and 2 of a cell."""
    above, below = slot[1], slot[2]
    return float(np.hypot(layout.x_m[above] - layout.x_m[below], layout.y_m[above] - layout.y_m[below]))


def draw_cells(cells: bytes, pixels: list[CellSlot], height_um: float, pixel_count: int) -> FloatArray:
    """Return the height of each pixel, µm, [p]. A dot without a pixel, as 7 and 8 in a line of text, is left out."""
    heights_um = np.zeros(pixel_count)
    for dots, slot in zip(cells, pixels, strict=True):
        heights_um[[pixel for dot, pixel in slot.items() if dots >> (dot - 1) & 1]] = height_um
    return heights_um
