"""Braille text on the lattice, wrapped at words and split into pages."""

from dataclasses import dataclass
from itertools import groupby

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import Config
from optodrive.planning.stimuli.braille import SPACE, Cell, encode_lines
from optodrive.planning.stimuli.liblouis import translate_lines
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.planning.stimuli.refresh import BeamTimeEstimator, hold_picture, sequence_end_s

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


def build_text(
    config: Config,
    where: str,
    text: str,
    height_m: float,
    seconds: float,
    dot_step: int = 1,
    cell_gap: int = 1,
    line_gap: int = 1,
    table: str | None = None,
) -> FrameSequence:
    """Build text in braille from the top left, each page for `seconds` or as long as the beam needs.

    table: of liblouis; without one, text is uncontracted English. Raises InputError (bad_text, does_not_fit, and with a
    table bad_table, missing_library).
    """
    lines = encode_lines(text, f"{where}: text") if table is None else translate_lines(text, table, where)
    if not any(lines):
        raise InputError(f"{where}: text", text, "at least one character to show", code="bad_text")
    return show_lines(config, where, lines, height_m, seconds, Spacing(dot_step, cell_gap, line_gap))


def show_lines(
    config: Config,
    where: str,
    lines: list[list[list[Cell]]],
    height_m: float,
    seconds: float,
    spacing: Spacing,
) -> FrameSequence:
    """Build lines of words in braille, wrapped into pages as by build_text. Raises InputError (does_not_fit)."""
    estimator = BeamTimeEstimator(config)
    slots = find_line_slots(estimator.lattice, spacing)
    if not slots:
        raise _too_small_error(config, where, spacing)
    rows = wrap_words(lines, [len(line) for line in slots])
    frames: list[TactileFrame] = []
    for first in range(0, len(rows), len(slots)):
        target_m = _draw_page(rows[first : first + len(slots)], slots, height_m, len(estimator.lattice.layout))
        frames += hold_picture(
            estimator,
            target_m,
            seconds,
            f"page-{first // len(slots) + 1}",
            sequence_end_s(FrameSequence(tuple(frames[-1:]))),
        )
    return FrameSequence(frames=tuple(frames))


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


def wrap_words(lines: list[list[list[Cell]]], widths: list[int]) -> list[list[Cell]]:
    """Wrap words into rows of cells, row k at most widths[k mod n] long. A word longer than its row is split."""
    rows: list[list[Cell]] = []
    for words in lines:
        rows.append([])
        for word in words:
            rest = word
            gap = [SPACE] if rows[-1] else []
            if rows[-1] and len(rows[-1]) + 1 + len(rest) > widths[(len(rows) - 1) % len(widths)]:
                rows.append([])
                gap = []
            rows[-1] += gap
            while len(rows[-1]) + len(rest) > (width := widths[(len(rows) - 1) % len(widths)]):
                space = width - len(rows[-1])
                rows[-1] += rest[:space]
                rest = rest[space:]
                rows.append([])
            rows[-1] += rest
    return rows


def _draw_page(rows: list[list[Cell]], slots: list[list[CellSlot]], height_m: float, pixel_count: int) -> FloatArray:
    target_m = np.zeros(pixel_count)
    for row, line in zip(rows, slots, strict=False):
        for cell, slot in zip(row, line, strict=False):
            target_m[[slot[dot] for dot in cell]] = height_m
    return target_m


def _too_small_error(config: Config, where: str, spacing: Spacing) -> InputError:
    rows, columns = spacing.cell_size
    expected = f"a display with {rows} × {columns} pixels for a cell"
    found = f"{config.display.rows} × {config.display.columns}"
    return InputError(f"{where}: {config.name}", found, expected, code="does_not_fit")
