"""Columns of the files that oscilloscopes, loggers and their programs write: text, TDMS, LVM and MATLAB.

A text file has lines about the instrument, mostly a row of names and a row of units, then rows of numbers. The rows are
found by their shape: of the separators, the one whose rows have the same number of cells and the most numbers. What can
be read in two ways, such as points and commas in the numbers of one file, is refused.
"""

import csv
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.extras import import_extra
from optodrive.core.files import read_bounded
from optodrive.core.numeric_tables import MICRO, OTHER_UNITS
from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.recording.storage import NUMBERS_MAX, convert_errors, format_name

FILE_BYTES_MAX, TEXT_BYTES_MAX = 2**30, 10**8
SEPARATORS = "\t;, "
GAPS = frozenset({"", "-", "--", "---", "nan", "n/a", "#n/a", "na", "null", "ol", "ovld", "over", "overflow"})
"""Cells without a number, in small letters: a gap, or an overload of the input."""
NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?")
CLOCK = re.compile(r"(?:(\d{4}-\d\d-\d\d)[ T])?(\d{1,2}):(\d\d):(\d\d(?:[.,]\d+)?)")
"""A time of day, or of ISO 8601."""
UNIT_IN_NAME = re.compile(r"(.*?)[\s_]*[\[(]\s*([^\])]*?)\s*[\])]\s*")
LINES_BEFORE_MAX = 200
"""Most lines before the numbers."""
SAMPLED_LINES = 2000
"""Lines by which the separator is chosen."""

UNITS_OF_FILES: dict[str, tuple[str, float, float]] = {
    unit: (si, factor, 0.0) for si, others in OTHER_UNITS.items() for unit, factor in ({si: 1.0} | others).items()
} | {
    "nm": ("m", 1e-9, 0.0), "ns": ("s", 1e-9, 0.0), "min": ("s", 60.0, 0.0), "sec": ("s", 1.0, 0.0),
    "Second": ("s", 1.0, 0.0), "°": ("rad", np.pi / 180.0, 0.0),
    "K": ("K", 1.0, 0.0), "°C": ("K", 1.0, ZERO_CELSIUS_K), "degC": ("K", 1.0, ZERO_CELSIUS_K),
    "°F": ("K", 5.0 / 9.0, ZERO_CELSIUS_K - 160.0 / 9.0),
    "V": ("V", 1.0, 0.0), "mV": ("V", 1e-3, 0.0), "uV": ("V", 1e-6, 0.0), "Volt": ("V", 1.0, 0.0),
    "A": ("A", 1.0, 0.0), "mA": ("A", 1e-3, 0.0),
}  # fmt: skip
"""SI unit, factor and offset of the units that instruments write."""


def find_unit(unit: str) -> tuple[str, float, float] | None:
    """Return the SI unit, factor and offset of a file's unit, or None if it is unknown."""
    return UNITS_OF_FILES.get(unit.translate(MICRO))


@dataclass(frozen=True, eq=False)
class Column:
    """One column of a file.

    table: group or segment that it belongs to, or empty; unit: as the file states it, or empty;
    value: [m], NaN where a sample is missing; t_s: [m], times that the file implies by a rate, s
    """

    table: str
    name: str
    unit: str
    value: FloatArray
    t_s: FloatArray | None = None

    @property
    def key(self) -> str:
        """Name by which a map selects the column."""
        return f"{self.table}/{self.name}" if self.table else self.name


@dataclass(frozen=True)
class InstrumentFile:
    """Columns of a file, with notes on its encoding, its separator, its first row of numbers and its gaps."""

    path: Path
    columns: tuple[Column, ...]
    notes: tuple[str, ...]

    def find(self, place: str, key: str) -> Column:
        """Return a column by its name, or by table and name. Raise InputError if there is none, or more than one."""
        found = [column for column in self.columns if key in (column.key, column.name)]
        exact = [column for column in found if column.key == key]
        if len(exact or found) != 1:
            keys = ", ".join(repr(format_name(column.key)) for column in self.columns)[:300]
            problem = "in none" if not found else f"in {len(found)} columns"
            raise InputError(place, Unquoted(f"{key!r} {problem} of {self.path}"), f"one of {keys}")
        return (exact or found)[0]


def read_instrument_file(path: Path) -> InstrumentFile:
    """Read a file by its suffix: .tdms, .lvm, .mat, any other as text. Raise InputError."""
    readers: dict[str, Callable[[Path], InstrumentFile]] = {".tdms": _read_tdms, ".lvm": _read_lvm, ".mat": _read_mat}
    if not path.is_file():
        raise InputError(str(path), Unquoted("no file of this name"), "a file of an instrument")
    if path.stat().st_size > FILE_BYTES_MAX:
        raise InputError(str(path), Unquoted(f"{path.stat().st_size} bytes"), f"at most {FILE_BYTES_MAX}")
    with convert_errors(str(path), "a file of an instrument"):
        found = readers.get(path.suffix.lower(), _read_text)(path)
    if not found.columns:
        raise InputError(str(path), Unquoted("no columns of numbers"), "at least one")
    return found


# Text


def _read_text(path: Path) -> InstrumentFile:
    text, encoding = _decode(read_bounded(path, TEXT_BYTES_MAX))
    lines = text.splitlines()
    separator = max(SEPARATORS, key=lambda each: _count_numbers(lines[:SAMPLED_LINES], each))
    rows = _split(lines, separator)
    width = _find_width(rows)
    first = next((at for at, row in enumerate(rows[: LINES_BEFORE_MAX + 1]) if _is_data(row, width)), None)
    if width < 2 or first is None:
        found = Unquoted(f"no rows of numbers within the first {LINES_BEFORE_MAX} lines")
        raise InputError(str(path), found, "two or more columns, separated by tabs, semicolons, commas or spaces")
    names, units = _read_header(rows[:first], width)
    cells = _collect_cells(path, rows, first, width)
    decimal = _find_decimal(path, cells)
    columns, notes, gaps = [], [], 0
    for name, unit, column in zip(names, units, zip(*cells, strict=True), strict=True):
        stated = [cell for cell in column if cell.lower() not in GAPS]
        # Some oscilloscopes state their settings in columns beside the first rows of numbers.
        if not stated or (2 * len(stated) <= len(column) and not all(map(_is_value, stated))):
            notes.append(f"{name!r} not read: {'empty' if not stated else 'text'}")
            continue
        value, is_clock = _parse_column(path, name, column, decimal)
        gaps += int(np.isnan(value).sum())
        columns.append(Column("", name, "s" if is_clock else unit, value))
    shown = {"\t": "tab", " ": "space"}.get(separator, separator)
    text_notes = f"{encoding}, separator {shown!r}, decimal {decimal!r}", f"numbers from line {first + 1}, {gaps} gaps"
    return InstrumentFile(path, tuple(columns), (*text_notes, *notes))


def _decode(content: bytes) -> tuple[str, str]:
    """Return the text and the name of its encoding. A file that is neither UTF-8 nor UTF-16 is of Windows."""
    marked = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    if marked or b"\0" in content[:2]:
        encoding = "utf-16" if marked else "utf-16-be" if content[:1] == b"\0" else "utf-16-le"
        return content.decode(encoding), encoding
    try:
        return content.decode("utf-8-sig"), "utf-8"
    except UnicodeDecodeError:
        return content.decode("cp1252"), "windows-1252"


def _split(lines: list[str], separator: str) -> list[list[str]]:
    if separator == " ":
        return [line.split() for line in lines]
    return [
        [cell.strip() for cell in row] for row in (next(csv.reader([line], delimiter=separator), []) for line in lines)
    ]


def _is_value(cell: str) -> bool:
    return NUMBER.fullmatch(cell.strip()) is not None or CLOCK.fullmatch(cell.strip()) is not None


def _is_data(row: list[str], width: int) -> bool:
    """Return whether a row has the width of the table, and no text but in the columns of an oscilloscope's notes."""
    values = sum(map(_is_value, row))
    return len(row) == width and values >= 2 and _is_value(row[-1] or next((cell for cell in row[::-1] if cell), ""))


def _count_numbers(lines: list[str], separator: str) -> int:
    rows = _split(lines, separator)
    width = _find_width(rows)
    counts = [sum(map(_is_value, row)) for row in rows if len(row) == width]
    return sum(count for count in counts if count >= 2)


def _find_width(rows: list[list[str]]) -> int:
    """Return the most frequent number of cells of the rows with two or more numbers, or 0."""
    counts = Counter(len(row) for row in rows[:SAMPLED_LINES] if sum(map(_is_value, row)) >= 2)
    return counts.most_common(1)[0][0] if counts else 0


def _read_header(before: list[list[str]], width: int) -> tuple[list[str], list[str]]:
    """Return names and units by the last rows before the numbers that have the width of the table."""
    header = [row for row in before if len(row) == width and any(row)][-2:]
    units = [""] * width
    if len(header) == 2 and all(_strip_unit(cell) is not None for cell in header[1] if cell):
        units = [_strip_unit(cell) or "" for cell in header[1]]
        header = header[:1]
    stated = header[-1] if header else [""] * width
    names = []
    for at, name in enumerate(stated):
        within = UNIT_IN_NAME.fullmatch(name)
        if within is not None and not units[at] and _strip_unit(within[2]) is not None:
            name, units[at] = within[1], within[2]
        names.append(name or f"column {at + 1}")
    twice = Counter(names)
    return [name if twice[name] == 1 else f"{name} {at + 1}" for at, name in enumerate(names)], units


def _strip_unit(cell: str) -> str | None:
    """Return the unit that a cell states, also in brackets, or None for another text."""
    unit = cell.strip().strip("()[]").strip()
    return unit if find_unit(unit) is not None else None


def _collect_cells(path: Path, rows: list[list[str]], first: int, width: int) -> list[list[str]]:
    cells = []
    for at, row in enumerate(rows[first:], first):
        if not any(row):
            continue
        if len(row) != width:
            raise InputError(f"{path}: line {at + 1}", Unquoted(f"{len(row)} cells"), f"{width}, as in the others")
        cells.append(row)
    if len(cells) * width > NUMBERS_MAX:
        raise InputError(str(path), Unquoted(f"{len(cells)} rows of {width}"), f"at most {NUMBERS_MAX} numbers")
    return cells


def _find_decimal(path: Path, cells: list[list[str]]) -> str:
    """Return the decimal separator. Refuse a file whose numbers have both: one of them groups thousands."""
    numbers = [cell for row in cells for cell in row if NUMBER.fullmatch(cell)]
    has = {mark: next((cell for cell in numbers if mark in cell), None) for mark in ".,"}
    if has["."] is not None and has[","] is not None:
        found = Unquoted(f"{has['.']!r} and {has[',']!r}")
        raise InputError(str(path), found, "decimal points or decimal commas, not both")
    return "." if has[","] is None else ","


def _parse_column(path: Path, name: str, cells: Sequence[str], decimal: str) -> tuple[FloatArray, bool]:
    """Return the numbers of a column, or its times since the first, s, and whether these are of a clock."""
    value, clocks = np.full(len(cells), np.nan), 0
    for at, cell in enumerate(cells):
        if NUMBER.fullmatch(cell):
            value[at] = float(cell.replace(",", "."))
        elif (clock := CLOCK.fullmatch(cell)) is not None:
            value[at], clocks = _convert_clock(*clock.groups()), clocks + 1
        elif cell.lower() not in GAPS:
            place = f"{path}: {format_name(name)}, row {at + 1} of the numbers"
            raise InputError(place, cell, f"a number with {decimal!r}, or an empty cell for a gap")
    is_known = np.isfinite(value)
    if clocks not in (0, is_known.sum()):
        raise InputError(f"{path}: {format_name(name)}", Unquoted("times beside numbers"), "times or numbers")
    if clocks:
        known = value[is_known] - value[is_known][0]
        # A clock without a date begins anew at midnight.
        value[is_known] = known + 86400.0 * np.concatenate([[0.0], np.cumsum(np.diff(known) < -43200.0)])
    return value, clocks > 0


def _convert_clock(date: str | None, hour: str, minute: str, second: str) -> float:
    """Return the time of a clock, s, since the first day of the calendar if it states one."""
    day_s = 0.0 if date is None else 86400.0 * datetime.fromisoformat(date).toordinal()
    return day_s + 3600.0 * int(hour) + 60.0 * int(minute) + float(second.replace(",", "."))


# Files of programs


def _read_tdms(path: Path) -> InstrumentFile:
    nptdms = import_extra("nptdms", "npTDMS", "instruments")
    columns = []
    for group in nptdms.TdmsFile.read(path).groups():
        for channel in group.channels():
            value = channel[:]
            if len(value) == 0 or not np.issubdtype(value.dtype, np.number):
                continue
            properties = channel.properties
            step_s = float(properties.get("wf_increment", 0.0))
            begin_s = float(properties.get("wf_start_offset", 0.0))
            t_s = np.asarray(begin_s + step_s * np.arange(len(value)), dtype=np.float64) if step_s > 0 else None
            unit = str(properties.get("unit_string", ""))
            columns.append(Column(group.name, channel.name, unit, np.asarray(value, dtype=np.float64), t_s))
    return InstrumentFile(path, tuple(columns), ("TDMS",))


def _read_lvm(path: Path) -> InstrumentFile:
    lvm_read = import_extra("lvm_read", "lvm_read", "instruments")
    read = lvm_read.read(str(path), read_from_pickle=False, dump_file=False)
    columns = []
    for at in range(int(read["Segments"])):
        segment = read[at]
        table = f"segment {at + 1}" if read["Segments"] > 1 else ""
        data = np.atleast_2d(np.asarray(segment["data"], dtype=np.float64))
        names = [str(name).strip() for name in segment["Channel names"]]
        units = [str(unit).strip() for unit in segment.get("Y_Unit_Label", [])]
        has_time = names[:1] == ["X_Value"]
        for column, name in enumerate(names):
            if name == "Comment" or column >= data.shape[1]:
                continue
            channel = column - has_time
            if has_time and column == 0:
                columns.append(Column(table, name, "s", data[:, 0]))
                continue
            unit = units[channel] if channel < len(units) else ""
            columns.append(Column(table, name, unit, data[:, column], _find_lvm_times(segment, channel, len(data))))
    return InstrumentFile(path, tuple(columns), (f"LVM, decimal {read['Decimal_Separator']!r}",))


def _find_lvm_times(segment: dict[Any, Any], channel: int, count: int) -> FloatArray | None:
    steps, begins = segment.get("Delta_X", []), segment.get("X0", [])
    if channel >= len(steps) or not float(steps[channel]) > 0.0:
        return None
    begin_s = float(begins[channel]) if channel < len(begins) else 0.0
    return np.asarray(begin_s + float(steps[channel]) * np.arange(count))


def _read_mat(path: Path) -> InstrumentFile:
    scipy_io = import_extra("scipy.io", "scipy")
    try:
        arrays = scipy_io.loadmat(path)
        kind = "MATLAB 5"
    except NotImplementedError:  # of version 7.3, which is HDF5
        h5py = import_extra("h5py")
        with h5py.File(path) as file:
            arrays = {
                name: item[()].T
                for name, item in file.items()
                if isinstance(item, h5py.Dataset) and np.issubdtype(item.dtype, np.number)
            }
        kind = "MATLAB 7.3"
    columns = []
    for name, array in arrays.items():
        if name.startswith("__") or not np.issubdtype(np.asarray(array).dtype, np.number) or np.asarray(array).size < 2:
            continue
        matrix = np.asarray(array, dtype=np.float64)
        matrix = matrix.reshape(-1, 1) if 1 in matrix.shape or matrix.ndim == 1 else matrix
        if matrix.ndim != 2:
            continue
        names = [name] if matrix.shape[1] == 1 else [f"{name}({at + 1})" for at in range(matrix.shape[1])]
        columns += [Column("", each, "", matrix[:, at].copy()) for at, each in enumerate(names)]
    return InstrumentFile(path, tuple(columns), (kind,))
