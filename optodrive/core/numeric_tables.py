"""CSV tables with a header line, read in the dialects of spreadsheets and instruments, and written in blocks of rows.

A table may begin with comments and Excel's line about the separator, be of UTF-8 or UTF-16, with or without a mark,
have commas, semicolons or tabs between the cells, quoted cells, and decimal commas where these are no separators.
Columns are found by name, in any order among others, in another case, and with another unit in the name, x_mm or
x [mm] for x_m. What can be read in two ways is refused.
"""

import csv
import re
from array import array
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO, TextIOWrapper
from math import isfinite, pi
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, Never

import numpy as np

from optodrive.core.errors import InputError, Unquoted, suggest_near_name
from optodrive.core.files import atomic_write, read_bounded
from optodrive.core.types.arrays import FloatArray

ROWS_PER_WRITE = 50_000
"""Rows formatted per write."""
COMMENT, SEPARATOR = "#", "sep="
"""Beginnings of lines before the header: of a note, and of Excel's line about the separator."""
SEPARATORS = "\t;,"
OTHER_UNITS = {
    "m": {"mm": 1e-3, "cm": 1e-2, "um": 1e-6},
    "s": {"ms": 1e-3, "us": 1e-6},
    "rad": {"mrad": 1e-3, "urad": 1e-6, "deg": pi / 180},
    "W": {"mW": 1e-3},
    "N": {"mN": 1e-3, "uN": 1e-6},
}
"""Units that a column's name may state, with their factors, by the unit that is expected."""
FORMULA_STARTS = "=+-@\t\r"
"""Characters with which a spreadsheet begins a formula."""
MICRO = str.maketrans("µμ", "uu")
NO_ALIASES: Mapping[str, Never] = MappingProxyType({})


class CsvTable:
    """The columns of given names of a CSV file, read row by row.

    comments: lines before the header, without their mark; header_line: number of the header's line
    """

    def __init__(
        self, file: BinaryIO, place: str, columns: tuple[str, ...], aliases: Mapping[str, str] = NO_ALIASES
    ) -> None:
        """Read the header. Raise InputError if a column is missing or stands twice.

        place: of the table in errors; aliases: a further name by column
        """
        self.place, self.columns = place, columns
        self._lines = self._iterate_lines(file)
        self.comments: list[str] = []
        header = next(self._lines, "")
        while header.startswith((COMMENT, SEPARATOR)):
            self.comments.append(header.removeprefix(COMMENT).strip(" \t;,\n"))
            header = next(self._lines, "")
        self.header_line = len(self.comments) + 1
        self._read_header(header.strip("\n "), aliases)

    @property
    def is_plain(self) -> bool:
        """Whether the table has the columns alone, in their order, with commas between them."""
        return self._separator == "," and self._indices == list(range(self._width))

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the line number and the columns' cells of every row that is not empty. Raise InputError."""
        reader = csv.reader(self._lines, delimiter=self._separator)
        picks = None if self._indices == list(range(self._width)) else self._indices
        try:
            for cells in reader:
                if len(cells) != self._width or not cells[0].strip():
                    cells = self._fit_row(self.header_line + reader.line_num, cells)
                    if not cells:
                        continue
                yield self.header_line + reader.line_num, cells if picks is None else [cells[each] for each in picks]
        except csv.Error as error:
            place = f"{self.place}: row {self.header_line + reader.line_num}"
            raise InputError(place, Unquoted(str(error)), "a CSV file") from None

    def read_numbers(
        self, missing: Container[str] = (), on_row: Callable[[], None] = lambda: None, finite: bool = False
    ) -> FloatArray:
        """Return all rows as numbers in the units of the columns' names, [n, columns].

        missing: columns whose cells may be empty, which is NaN; on_row: called before each row is kept; finite: whether
        other numbers are refused. Raises InputError that names row, column and value.
        """
        numbers = array("d")
        for line, cells in self.rows():
            on_row()
            try:
                values = [float(cell) for cell in cells]
            except ValueError:
                values = self._parse_row(line, cells, missing)
            if finite and not all(map(isfinite, values)):
                at = next(index for index, value in enumerate(values) if not isfinite(value))
                raise InputError(f"{self.place}: row {line}: {self.columns[at]}", values[at], "a finite number")
            numbers.extend(values)
        return self.scale(np.array(numbers, dtype=np.float64).reshape(-1, len(self.columns)))

    def scale(self, table: FloatArray) -> FloatArray:
        """Convert numbers from the units that the header states, [n, columns]."""
        return table if all(factor == 1.0 for factor in self._factors) else table * self._factors

    def parse_number(self, line: int, column: str, cell: str) -> float:
        """Return the number of a cell, with a point or a decimal comma. Raise InputError."""
        try:
            return float(cell.strip().replace(",", "."))
        except ValueError:
            raise InputError(f"{self.place}: row {line}: {column}", cell.strip(), "a number") from None

    def read_rest(self) -> str:
        """Return the text of all rows."""
        return "".join(self._lines)

    def _iterate_lines(self, file: BinaryIO) -> Iterator[str]:
        first = file.read(2)
        file.seek(0)
        # A file without a mark, whose first character is of ASCII: of UTF-16 every other byte is zero.
        guess = "utf-16-le" if first[1:] == b"\0" else "utf-16-be" if first[:1] == b"\0" else "utf-8-sig"
        encoding = "utf-16" if first in (b"\xff\xfe", b"\xfe\xff") else guess
        try:
            self._text = TextIOWrapper(file, encoding, newline=None)  # which would close the file at its own end
            yield from self._text
        except UnicodeError:
            raise InputError(self.place, Unquoted("not text"), "a CSV file in UTF-8 or UTF-16") from None

    def _read_header(self, header: str, aliases: Mapping[str, str]) -> None:
        """Find the separator and the columns. Raise the error of the most frequent separator if none finds them."""
        place = f"{self.place}: " + (f"line {self.header_line}" if self.comments else "first line")
        outside = re.sub('"[^"]*"', "", header)
        errors = []
        for separator in sorted(SEPARATORS, key=outside.count, reverse=True):
            names = [name.strip() for name in next(csv.reader([header], delimiter=separator), [])]
            try:
                self._indices, self._factors = _find_columns(place, names, self.columns, aliases)
            except InputError as error:
                errors.append(error)
            else:
                self._separator, self._width = separator, len(names)
                return
        raise errors[0]

    def _fit_row(self, line: int, cells: list[str]) -> list[str]:
        """Return a row without empty cells beyond the header's, or none if all are empty. Raise InputError."""
        if not any(cell.strip() for cell in cells):
            return []
        if len(cells) == self._width:
            return cells
        if len(cells) > self._width and not any(cell.strip() for cell in cells[self._width :]):
            return cells[: self._width]
        expected = f"{self._width} cells, as in the header"
        if self._separator == "," and len(cells) == 2 * self._width:
            expected += ": decimal commas need semicolons between the cells"
        found = Unquoted(f"{len(cells)} cells, {self._separator.join(cells)[:100]!r}")
        raise InputError(f"{self.place}: row {line}", found, expected)

    def _parse_row(self, line: int, cells: list[str], missing: Container[str]) -> list[float]:
        """Return the numbers of a row with an empty cell, a decimal comma, or another text, which is refused."""
        if any("," in cell for cell in cells) and any("." in cell and "," not in cell for cell in cells):
            found = self._separator.join(cells)
            raise InputError(f"{self.place}: row {line}", found, "decimal points or decimal commas, not both")
        return [
            float("nan") if column in missing and not cell.strip() else self.parse_number(line, column, cell)
            for column, cell in zip(self.columns, cells, strict=True)
        ]


@contextmanager
def open_table(
    path: Path, columns: tuple[str, ...], place: str = "", aliases: Mapping[str, str] = NO_ALIASES
) -> Iterator[CsvTable]:
    """Open a CSV file of any size. Raise InputError as `CsvTable`, or if it cannot be read.

    place: of the table in errors, by default the path
    """
    try:
        with path.open("rb") as file:
            yield CsvTable(file, place or str(path), columns, aliases)
    except OSError as error:
        raise InputError(place or str(path), error.strerror or str(error), "a readable file") from None


def read_columns(path: Path, columns: tuple[str, ...]) -> FloatArray:
    """Read the columns of these names from a CSV file of bounded size into a finite array [n, columns].

    Raises InputError that names row, column and value.
    """
    content = read_bounded(path)
    table = CsvTable(BytesIO(content), str(path), columns)
    if table.is_plain:
        body = table.read_rest().rstrip("\n, ")
        numbers = None if '"' in body else _parse_all(body, body.count("\n") + 1 if body else 0, len(columns))
        if numbers is not None and np.isfinite(numbers).all():
            return table.scale(numbers)
        table = CsvTable(BytesIO(content), str(path), columns)
    return table.read_numbers(finite=True)


def read_comments(path: Path) -> list[str]:
    """Return the comments before the header of a CSV file, without their mark."""
    return CsvTable(BytesIO(read_bounded(path)), str(path), ()).comments


def _find_columns(
    place: str, names: list[str], columns: tuple[str, ...], aliases: Mapping[str, str]
) -> tuple[list[int], list[float]]:
    """Return the index of each column, and the factor of the unit that its name states."""
    if names and all(map(_is_number, names)):
        raise InputError(place, Unquoted("numbers"), f"the names of the columns: {','.join(columns)}")
    stated = [re.sub(r"[\s_]*[\[(]\s*(\S+?)\s*[\])]$", r"_\1", name).translate(MICRO) for name in names]
    indices, factors = [], []
    for column in columns:
        spellings = _list_spellings(column)
        if column in aliases:
            spellings |= _list_spellings(aliases[column])
        found = [(index, spellings[name]) for index, name in enumerate(stated) if name in spellings]
        if not found:  # another case; names that differ in their case alone are told apart above
            lower = {name.lower(): factor for name, factor in spellings.items()}
            found = [(index, lower[name.lower()]) for index, name in enumerate(stated) if name.lower() in lower]
        if len(found) > 1:
            twice = " and ".join(repr(names[index]) for index, _ in found)
            raise InputError(place, Unquoted(twice), f"one column {column}")
        if not found:
            near = suggest_near_name(column, [name for name in stated if name])
            listed = Unquoted("columns " + ", ".join(map(repr, names))[:150] if any(names) else "an empty line")
            raise InputError(place, listed, f"a column {column} too{f' ({near})' if near else ''}")
        indices.append(found[0][0])
        factors.append(found[0][1])
    return indices, factors


def _list_spellings(column: str) -> dict[str, float]:
    """Return the names of a column in its own and in other units, with the factors of these."""
    stem, _, unit = column.rpartition("_")
    return {column: 1.0} | {f"{stem}_{other}": factor for other, factor in OTHER_UNITS.get(unit, {}).items()}


def escape_formula(cell: object) -> object:
    """Return a cell, text that a spreadsheet would run as a formula with an apostrophe before it."""
    runs = isinstance(cell, str) and cell[1:] and cell[0] in FORMULA_STARTS and not _is_number(cell)
    return f"'{cell}" if runs else cell


def _parse_all(body: str, rows: int, columns: int) -> FloatArray | None:
    """Return the table, or None if any cell is invalid."""
    if body.count(",") != rows * (columns - 1):
        return None
    try:
        values = np.array(body.replace("\n", ",").split(","), dtype=np.float64) if rows else np.zeros(0)
    except ValueError:
        return None
    return values.reshape(rows, columns) if len(values) == rows * columns else None


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
