"""Measured spots with the codes of the beam and its positions on the display."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.numeric_tables import read_columns, read_comments, write_columns
from optodrive.core.types.arrays import FloatArray, freeze_arrays
from optodrive.device.field_geometry import CODE_MAX

COLUMNS = ("x_code", "y_code", "x_m", "y_m")
ORIGIN = "optodrive spots of "
"""Beginning of the comment that names the display."""


@dataclass(frozen=True, eq=False)
class MeasuredSpots:
    """Codes of the converter, and positions of the beam on the display, m, all [n]."""

    x_code: FloatArray
    y_code: FloatArray
    x_m: FloatArray
    y_m: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.x_code)

    @classmethod
    def from_table(cls, table: FloatArray) -> Self:
        """Build spots from rows of x_code, y_code, x_m, y_m, [n, 4]."""
        x_code, y_code, x_m, y_m = np.array(table, dtype=np.float64).reshape(-1, 4).T.copy()
        return cls(x_code, y_code, x_m, y_m)

    def to_table(self) -> FloatArray:
        """Return rows of x_code, y_code, x_m, y_m, [n, 4]."""
        return np.column_stack([self.x_code, self.y_code, self.x_m, self.y_m])


def read_spots(path: Path, display: str = "") -> MeasuredSpots:
    """Read spots.csv. Raise InputError with file, row, column, value and expected value.

    display: name of the display, of which the spots must be if they name theirs; empty: any
    """
    table = read_columns(path, COLUMNS)
    comments = read_comments(path)
    named = next((line.removeprefix(ORIGIN) for line in comments if line.startswith(ORIGIN)), "")
    if display and named and named != display:
        raise InputError(f"{path}: spots", f"those of {named}", f"those of {display}, the configured display")
    if len(table) and np.all(np.abs(table[:, :2]) < 1.0) and np.any(table[:, :2]):
        swapped = np.abs(table[:, 2:]).max() > 100.0
        raise InputError(
            f"{path}: x_code, y_code",
            float(table[0, 0]),
            "codes of the converter, 0 to 65535; these look like metres"
            + (", with the columns of codes and of metres exchanged" if swapped else ""),
        )
    bad = np.argwhere((table[:, :2] < 0) | (table[:, :2] > CODE_MAX))
    if len(bad):
        row, column = bad[0].tolist()
        raise InputError(
            f"{path}: row {row + find_first_line(path)}: {COLUMNS[column]}",
            float(table[row, column]),
            f"0 to {CODE_MAX}",
        )
    _, first, copies = np.unique(table, axis=0, return_index=True, return_inverse=True)
    original = first[copies.ravel()]
    repeated = np.flatnonzero(original != np.arange(len(table)))
    if len(repeated):
        row, line = int(repeated[0]), find_first_line(path)
        raise InputError(
            f"{path}: row {row + line}",
            Unquoted(f"the numbers of row {original[row] + line}, as {len(repeated)} rows in all repeat others"),
            "each measurement once: copies would make the field look more certain than it is",
        )
    return MeasuredSpots.from_table(table)


def find_first_line(path: Path) -> int:
    """Return the line number of the first spot in a file."""
    return len(read_comments(path)) + 2


def write_spots(path: Path, spots: MeasuredSpots, display: str) -> None:
    """Write spots.csv atomically.

    display: name of the display that they were measured on
    """
    write_columns(path, COLUMNS, spots.to_table(), ("%.17g", "%.17g", "%.9g", "%.9g"), f"{ORIGIN}{display}")
