"""CSV tables of numbers with a header line, which lines of comments may precede, written in blocks of rows."""

import csv
import re
from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError, Unquoted, suggest_near_name
from optodrive.core.files import atomic_write, read_bounded
from optodrive.core.types.arrays import FloatArray

ROWS_PER_WRITE = 50_000
"""Rows formatted per write."""
COMMENT, SEPARATOR = "#", "sep="
"""Beginnings of lines before the header: of a note, and of Excel's line about the separator."""
OTHER_UNITS = {"m": {"mm": 1e-3, "cm": 1e-2, "um": 1e-6}, "s": {"ms": 1e-3, "us": 1e-6}}
"""Units that a column's name may state, with their factors, by the unit that is expected."""
FORMULA_STARTS = "=+-@\t\r"
"""Characters with which a spreadsheet begins a formula."""


def read_columns(path: Path, columns: tuple[str, ...]) -> FloatArray:
    """Read the columns of these names from a CSV file, after any comments, into a finite array [n, columns].

    The columns may stand in any order among others, be separated by commas, semicolons or tabs, be quoted, have decimal
    commas where these are no separators, and state another unit in their name: x_mm for x_m.

    Raises InputError that names row, column and value.
    """
    comments, text = split_comments(path)
    header, _, body = text.partition("\n")
    first_row = len(comments) + 2
    separator = next((each for each in "\t;" if each in header), ",")
    body = body.replace("\r", "").rstrip(f"\n{separator} ").lstrip("\n")
    place = f"{path}: " + (f"line {first_row - 1}" if comments else "first line")
    names = next(csv.reader([header.strip()], delimiter=separator), [])
    indices, factors = _find_columns(place, [name.strip() for name in names], columns)
    table = None
    if indices == list(range(len(columns))) and separator == "," and '"' not in body:
        table = _parse_all(body, body.count("\n") + 1 if body else 0, len(columns))
    if table is None:
        table = _parse_rows(path, body, separator, columns, indices, len(names), first_row)
    bad = np.argwhere(~np.isfinite(table))
    if len(bad):
        row, column = bad[0].tolist()
        place = f"{path}: row {row + first_row}: {columns[column]}"
        raise InputError(place, float(table[row, column]), "a finite number")
    return table if all(factor == 1.0 for factor in factors) else table * factors


def _find_columns(place: str, names: list[str], columns: tuple[str, ...]) -> tuple[list[int], list[float]]:
    """Return the index of each column, and the factor of the unit that its name states."""
    known = [re.sub(r"[\s_]*[\[(]\s*(\S+?)\s*[\])]$", r"_\1", name).lower().replace("µ", "u") for name in names]
    if names and all(map(_is_number, names)):
        raise InputError(place, Unquoted("numbers"), f"the names of the columns: {','.join(columns)}")
    indices, factors = [], []
    for column in columns:
        stem, _, unit = column.rpartition("_")
        spellings = {column: 1.0} | {f"{stem}_{other}": factor for other, factor in OTHER_UNITS.get(unit, {}).items()}
        found = [(index, spellings[name]) for index, name in enumerate(known) if name in spellings]
        if len(found) > 1:
            twice = " and ".join(repr(names[index]) for index, _ in found)
            raise InputError(place, Unquoted(twice), f"one column {column}")
        if not found:
            near = suggest_near_name(column, [name for name in known if name])
            listed = Unquoted("columns " + ", ".join(map(repr, names))[:200] if any(names) else "an empty line")
            raise InputError(place, listed, f"a column {column} too{f' ({near})' if near else ''}")
        indices.append(found[0][0])
        factors.append(found[0][1])
    return indices, factors


def escape_formula(cell: object) -> object:
    """Return a cell, text that a spreadsheet would run as a formula with an apostrophe before it."""
    runs = isinstance(cell, str) and cell[1:] and cell[0] in FORMULA_STARTS and not _is_number(cell)
    return f"'{cell}" if runs else cell


def split_comments(path: Path) -> tuple[list[str], str]:
    """Return the comments before the header of a CSV file, without their mark, and the text that follows them."""
    content = read_bounded(path)
    # A file without a mark, whose first character is of ASCII: of UTF-16 every other byte is zero.
    first = content[:2].ljust(2, b" ")
    guess = "utf-16-le" if first[1] == 0 else "utf-16-be" if first[0] == 0 else "utf-8-sig"
    encoding = "utf-16" if first in (b"\xff\xfe", b"\xfe\xff") else guess
    try:
        text = content.decode(encoding).replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise InputError(str(path), Unquoted("not text"), "a CSV file in UTF-8 or UTF-16") from None
    comments = []
    while text.startswith((COMMENT, SEPARATOR)):
        line, _, text = text.partition("\n")
        comments.append(line.removeprefix(COMMENT).strip(" \t;,"))
    return comments, text


def _parse_all(body: str, rows: int, columns: int) -> FloatArray | None:
    """Return the table, or None if any cell is invalid."""
    if body.count(",") != rows * (columns - 1):
        return None
    try:
        values = np.array(body.replace("\n", ",").split(","), dtype=np.float64) if rows else np.zeros(0)
    except ValueError:
        return None
    return values.reshape(rows, columns) if len(values) == rows * columns else None


def _parse_rows(
    path: Path,
    body: str,
    separator: str,
    columns: tuple[str, ...],
    indices: list[int],
    width: int,
    first_row: int,
) -> FloatArray:
    rows = []
    for number, line in enumerate(body.split("\n") if body else [], start=first_row):
        cells = next(csv.reader([line], delimiter=separator), [])
        if len(cells) != width:
            expected = f"{width} cells"
            if separator == "," and len(cells) == 2 * width:
                expected += ": decimal commas need semicolons between the cells"
            raise InputError(f"{path}: row {number}", line, expected)
        chosen = [cells[index].strip().replace(",", ".") for index in indices]
        try:
            rows.append([float(cell) for cell in chosen])
        except ValueError:
            at = next(index for index, cell in enumerate(chosen) if not _is_number(cell))
            raise InputError(f"{path}: row {number}: {columns[at]}", cells[indices[at]], "a number") from None
    return np.array(rows).reshape(-1, len(columns))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def write_columns(
    path: Path, columns: tuple[str, ...], table: FloatArray, formats: tuple[str, ...], comment: str = ""
) -> None:
    """Write a table [n, columns] atomically.

    formats: one printf format per column, such as %.3f; comment: one line before the header, none if empty
    """
    line = ",".join(formats) + "\n"
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        file.write(f"{COMMENT} {comment}\n" if comment else "")
        file.write(",".join(columns) + "\n")
        for first in range(0, len(table), ROWS_PER_WRITE):
            block = table[first : first + ROWS_PER_WRITE]
            file.write(line * len(block) % tuple(block.ravel().tolist()))
