"""Places of braille cells on the lattice."""

from dataclasses import dataclass
from itertools import groupby

from optodrive.planning.stimuli.pixel_lattice import Lattice

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
