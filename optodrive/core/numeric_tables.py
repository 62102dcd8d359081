"""CSV tables of numbers with a header line, which lines of comments may precede, written in blocks of rows."""

from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.files import atomic_write
from optodrive.core.types.arrays import FloatArray

ROWS_PER_WRITE = 50_000
"""Rows formatted per write."""
COMMENT = "#"
FORMULA_STARTS = "=+-@\t\r"
"""Characters with which a spreadsheet begins a formula."""


def read_columns(path: Path, columns: tuple[str, ...]) -> FloatArray:
    """Read a CSV file with exactly this header, after any comments, into a finite array [n, columns].

    Raises InputError that names row, column and value.
    """
    comments, text = split_comments(path)
    header, _, body = text.partition("\n")
    first_row = len(comments) + 2
    names = tuple(name.strip() for name in header.strip().split(","))
    if names != columns:
        place = "first line" if not comments else f"line {first_row - 1}"
        raise InputError(f"{path}: {place}", header.strip(), f"'{','.join(columns)}'")
    body = body.strip().replace("\r", "")
    rows = body.count("\n") + 1 if body else 0
    table = _parse_all(body, rows, len(columns))
    if table is None:
        table = _parse_rows(path, body, columns, first_row)
    bad = np.argwhere(~np.isfinite(table))
    if len(bad):
        row, column = bad[0].tolist()
        place = f"{path}: row {row + first_row}: {columns[column]}"
        raise InputError(place, float(table[row, column]), "a finite number")
    return table


def escape_formula(cell: object) -> object:
    """Return a cell, text that a spreadsheet would run as a formula with an apostrophe before it."""
    runs = isinstance(cell, str) and cell[1:] and cell[0] in FORMULA_STARTS and not _is_number(cell)
    return f"'{cell}" if runs else cell


def split_comments(path: Path) -> tuple[list[str], str]:
    """Return the comments before the header of a CSV file, without their mark, and the text that follows them."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(str(path), "not text", "a CSV file, UTF-8") from None
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
    comments = []
    while text.startswith(COMMENT):
        line, _, text = text.partition("\n")
        comments.append(line.removeprefix(COMMENT).strip())
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


def _parse_rows(path: Path, body: str, columns: tuple[str, ...], first_row: int) -> FloatArray:
    rows = []
    for number, line in enumerate(body.split("\n"), start=first_row):
        cells = line.split(",")
        if len(cells) != len(columns):
            raise InputError(f"{path}: row {number}", line, f"{len(columns)} numbers: {', '.join(columns)}")
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:
            at = next(index for index, cell in enumerate(cells) if not _is_number(cell))
            raise InputError(f"{path}: row {number}: {columns[at]}", cells[at], "a number") from None
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
