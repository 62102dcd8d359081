"""Braille text on the lattice, wrapped at words and split into pages."""

import unicodedata

import numpy as np

from optodrive.core.errors import InputError, Unquoted, build_nothing_raised_error
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import Config
from optodrive.planning.stimuli.braille import SPACE, Cell, encode_lines, translate_lines
from optodrive.planning.stimuli.pixel_lattice import CellSlot, Spacing, find_line_slots
from optodrive.planning.stimuli.refresh import BeamTimeEstimator, hold_picture, sequence_end_s
from optodrive.planning.stimuli.sequence_file import FRAMES_MAX

PAGES_MAX = 3_000
"""Largest number of pages of the display: about two seconds of computation."""
Lines = list[list[list[Cell]]]
"""Lines of words of cells."""


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
    lines = translate(text, table, f"{where}: text")
    if not any(lines):
        raise build_nothing_raised_error(f"{where}: text", "it is blank", "text with at least one raised dot")
    return show_pages(config, where, [lines], height_m, seconds, Spacing(dot_step, cell_gap, line_gap))


def translate(text: str, table: str | None, where: str) -> Lines:
    """Translate text into lines of words of cells, composed letters from their parts first. Raises as build_text."""
    composed = unicodedata.normalize("NFC", text)
    return encode_lines(composed, where) if table is None else translate_lines(composed, table, where)


def show_pages(
    config: Config,
    where: str,
    pages: list[Lines],
    height_m: float,
    seconds: float,
    spacing: Spacing,
) -> FrameSequence:
    """Build pages of lines of words in braille, wrapped as by build_text.

    Raises InputError (does_not_fit; too_many before a frame is built).
    """
    estimator = BeamTimeEstimator(config)
    slots = find_line_slots(estimator.lattice, spacing)
    if not slots:
        raise _too_small_error(config, where, spacing)
    shown: list[list[list[Cell]]] = []
    for lines in pages:
        rows = wrap_words(lines, [len(line) for line in slots])
        shown += [rows[first : first + len(slots)] for first in range(0, len(rows), len(slots))]
        if len(shown) > PAGES_MAX:
            found = Unquoted(f"more than {PAGES_MAX} pages of {config.name}")
            raise InputError(where, found, "fewer: a part of the file or text", code="too_many")
    frames: list[TactileFrame] = []
    for number, page in enumerate(shown, start=1):
        target_m = _draw_page(page, slots, height_m, len(estimator.lattice.layout))
        frames += hold_picture(
            estimator,
            target_m,
            seconds,
            f"page-{number}",
            sequence_end_s(FrameSequence(tuple(frames[-1:]))),
        )
        if len(frames) > FRAMES_MAX:
            found = Unquoted(f"{len(shown)} pages for {seconds:g} s each")
            raise InputError(where, found, f"pages that take at most {FRAMES_MAX} frames in all", code="too_many")
    return FrameSequence(frames=tuple(frames))


def wrap_words(lines: list[list[list[Cell]]], widths: list[int]) -> list[list[Cell]]:
    """Wrap words into rows of cells, row k at most widths[k mod n] long. A word longer than its row is split."""
    rows: list[list[Cell]] = []
    for words in lines:
        rows.append([])
        for word in words:
            gap = [SPACE] if rows[-1] else []
            if rows[-1] and len(rows[-1]) + 1 + len(word) > widths[(len(rows) - 1) % len(widths)]:
                rows.append([])
                gap = []
            rows[-1] += gap
            first = 0  # of the cells not yet shown: to cut them off would copy the rest of a long word in each row
            while len(rows[-1]) + len(word) - first > (width := widths[(len(rows) - 1) % len(widths)]):
                space = width - len(rows[-1])
                rows[-1] += word[first : first + space]
                first += space
                rows.append([])
            rows[-1] += word[first:]
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
