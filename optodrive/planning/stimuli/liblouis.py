"""Translation of text into braille cells by liblouis, the library of screen readers.

The library keeps its compiled tables in one process-wide list, without a lock of its own.
"""

import ctypes
import re
from functools import cache
from pathlib import Path
from threading import Lock

from optodrive.core.errors import MISSING, InputError, suggest_nearest
from optodrive.planning.stimuli.braille import Cell

LIBRARY = "liblouis.so.20"
TABLES = Path("/usr/share/liblouis/tables")
SUFFIXES = (".ctb", ".utb", ".tbl")
"""Suffixes of tables that translate, tried in this order."""
NAME = re.compile(r"[A-Za-z0-9_-]+(\.(ctb|utb|tbl))?")
DOTS_AS_UNICODE = 4 | 64
"""Mode: the output is dots, as characters of Unicode's braille block."""
NO_LOG = 60_000
FIRST_CELL, LAST_SIX_DOT_CELL = 0x2800, 0x283F
GROWTH = 8
"""Cells per character for which room is made: a capital letter with accents takes six."""
_lock = Lock()


def translate_lines(text: str, table: str, where: str) -> list[list[list[Cell]]]:
    """Translate text into lines of words of six-dot cells. Lines end at line breaks only.

    table: name of a liblouis table, such as en-ueb-g2. Raises InputError for an unknown table, one of eight dots
    (bad_table), a character that it does not know (bad_text), and without the library (missing_library).
    """
    library, file = _load_library(where), _find_table(table, where)
    return [_split_words(_translate(library, file, " ".join(line.split()), where)) for line in text.split("\n")]


@cache
def _load_library(where: str) -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(LIBRARY)
    except OSError:
        expected = "liblouis: apt-get install liblouis20 liblouis-data; without a table, text is uncontracted English"
        raise InputError(f"{where}: table", MISSING, expected, code="missing_library") from None
    library.lou_setLogLevel(NO_LOG)
    return library


def _find_table(table: str, where: str) -> bytes:
    """Return the file of a table. Names are plain: a caller of the daemon must not open files of its choice."""
    known = sorted(path.name for path in TABLES.glob("*") if path.suffix in SUFFIXES)
    if NAME.fullmatch(table):
        for name in (table, *(table + suffix for suffix in SUFFIXES)):
            if name in known:
                return str(TABLES / name).encode()
    near = suggest_nearest(table, sorted({name.rpartition(".")[0] for name in known}))
    expected = f"a table in {TABLES}, {'such as en-ueb-g2' if near.startswith('one of') else near}"
    raise InputError(f"{where}: table", table, expected, code="bad_table")


def _translate(library: ctypes.CDLL, file: bytes, line: str, where: str) -> list[Cell]:
    """Return the cells of a line."""
    encoding, width = ("utf-16-le", 2) if library.lou_charSize() == 2 else ("utf-32-le", 4)
    given = line.encode(encoding)
    size = len(given) // width
    room = GROWTH * size + 64
    result, read, written = ctypes.create_string_buffer(room * width), ctypes.c_int(size), ctypes.c_int(room)
    with _lock:
        succeeded = library.lou_translateString(
            file, given, ctypes.byref(read), result, ctypes.byref(written), None, None, DOTS_AS_UNICODE
        )
    if not succeeded or read.value != size:
        raise InputError(f"{where}: text", line, f"text that {Path(file.decode()).name} translates", code="bad_text")
    cells = list[Cell]()
    for character in result.raw[: written.value * width].decode(encoding):
        if not FIRST_CELL <= ord(character) <= LAST_SIX_DOT_CELL:
            expected = f"a table of six dots, not {Path(file.decode()).name}"
            raise InputError(f"{where}: table", character, expected, code="bad_table")
        dots = ord(character) - FIRST_CELL
        cells.append(frozenset(dot for dot in range(1, 7) if dots >> dot - 1 & 1))
    return cells


def _split_words(cells: list[Cell]) -> list[list[Cell]]:
    """Return the cells between blank ones."""
    words: list[list[Cell]] = [[]]
    for cell in cells:
        if cell:
            words[-1].append(cell)
        elif words[-1]:
            words.append([])
    return [word for word in words if word]
