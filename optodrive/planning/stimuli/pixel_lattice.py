"""Lattice of a display, which maps a place (row, column from the bottom left) to a pixel index, and its cells."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import IntArray, ReadOnlyArrays
from optodrive.device.config import Config, PixelLayout, build_pixel_layout


@dataclass(frozen=True, eq=False)
class Lattice(ReadOnlyArrays):
    """Places of a display's lattice.

    index: [rows, columns] pixel at a place, -1 if there is none; layout: the inverse, [p].
    """

    name: str
    index: IntArray
    layout: PixelLayout

    @classmethod
    def from_config(cls, config: Config) -> "Lattice":
        """Build the lattice of a configured display."""
        layout, shape = build_pixel_layout(config.display), (config.display.rows, config.display.columns)
        return cls(config.name, _index_places(layout, shape), layout)

    @classmethod
    def from_layout(cls, name: str, layout: PixelLayout) -> "Lattice":
        """Build the lattice of a layout, up to its last row and column."""
        return cls(name, _index_places(layout, (int(layout.row.max()) + 1, int(layout.column.max()) + 1)), layout)

    def pixel_at(self, row: int, column: int) -> int | None:
        """Return the pixel at a place, or None if there is none."""
        rows, columns = self.index.shape
        if not (0 <= row < rows and 0 <= column < columns):
            return None
        pixel = int(self.index[row, column])
        return pixel if pixel >= 0 else None

    def middle_pixel(self) -> int:
        """Return the pixel nearest to the display's middle, the lowest index among equals."""
        distance_m = np.round(np.hypot(self.layout.x_m, self.layout.y_m), 9)
        return int(np.argmin(distance_m))

    def pixels_around(
        self, centre: int | None, offsets: Iterable[tuple[int, int]], where: str, requirement: str
    ) -> list[int]:
        """Return the pixels at offsets (rows up, columns right) from a centre. None is the middle pixel.

        requirement: what must surround the centre, for the message. Raises InputError (does_not_fit).
        """
        centre = self.middle_pixel() if centre is None else centre
        row, column = int(self.layout.row[centre]), int(self.layout.column[centre])
        pixels = []
        for up, right in offsets:
            pixel = self.pixel_at(row + up, column + right)
            if pixel is None:
                rows, columns = self.index.shape
                raise InputError(
                    f"{where}: centre",
                    centre,
                    f"a pixel with {requirement} ({self.name} is {rows} × {columns})",
                    code="does_not_fit",
                )
            pixels.append(pixel)
        return pixels


def _index_places(layout: PixelLayout, shape: tuple[int, int]) -> IntArray:
    index = np.full(shape, -1, dtype=np.int64)
    index[layout.row, layout.column] = np.arange(len(layout))
    return index


DOT_OFFSETS = {1: (0, 0), 2: (1, 0), 3: (2, 0), 4: (0, 1), 5: (1, 1), 6: (2, 1)}
"""Offset (rows down, columns right) of each dot from the cell's top left, in dot steps."""


@dataclass(frozen=True)
class Spacing:
    """Spacing in lattice places: between dots of a cell, empty columns between cells, empty rows between lines."""

    dot_step: int
    cell_gap: int
    line_gap: int

    @property
    def cell_size(self) -> tuple[int, int]:
        """Rows and columns of a cell."""
        return 2 * self.dot_step + 1, self.dot_step + 1


CellSlot = dict[int, int]
"""Place of a cell on the lattice: dot to pixel."""


def find_line_slots(lattice: Lattice, spacing: Spacing) -> list[list[CellSlot]]:
    """Find the lines of cells that fit, top first: per line the longest run of cells with all six pixels present."""
    rows, columns = lattice.index.shape
    cell_rows, cell_columns = spacing.cell_size
    step_rows, step_columns = cell_rows + spacing.line_gap, cell_columns + spacing.cell_gap
    line_count, cell_count = (rows + spacing.line_gap) // step_rows, (columns + spacing.cell_gap) // step_columns
    top = (rows - (line_count * step_rows - spacing.line_gap)) // 2
    left = (columns - (cell_count * step_columns - spacing.cell_gap)) // 2
    lines = []
    for line in range(line_count):
        cells = [
            _find_cell_slot(lattice, top + line * step_rows, left + k * step_columns, spacing.dot_step)
            for k in range(cell_count)
        ]
        runs = [list(run) for whole, run in groupby(cells, key=lambda slot: slot is not None) if whole]
        if runs:
            lines.append([slot for slot in max(runs, key=len) if slot is not None])
    return lines


def _find_cell_slot(lattice: Lattice, from_top: int, from_left: int, dot_step: int) -> CellSlot | None:
    slot = {}
    for dot, (down, right) in DOT_OFFSETS.items():
        pixel = lattice.pixel_at(lattice.index.shape[0] - 1 - from_top - down * dot_step, from_left + right * dot_step)
        if pixel is None:
            return None
        slot[dot] = pixel
    return slot
