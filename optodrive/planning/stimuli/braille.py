"""Encoder of text in uncontracted braille cells (Unified English Braille, grade 1).

A cell is the set of its raised dots. Dots 1, 2, 3 run down the left column, 4, 5, 6 down the right one.
"""

import ctypes
import re
import unicodedata
from functools import cache
from pathlib import Path
from string import ascii_letters, ascii_lowercase
from threading import Lock
from typing import NamedTuple

from optodrive.core.errors import MISSING, InputError, suggest_near_name

Cell = frozenset[int]


def _parse_cells(dots: str) -> tuple[Cell, ...]:
    return tuple(frozenset(int(dot) for dot in cell) for cell in dots.split())


SPACE: Cell = frozenset()
CAPITAL_LETTER_INDICATOR = _parse_cells("6")
CAPITAL_WORD_INDICATOR = _parse_cells("6 6")
NUMERIC_INDICATOR = _parse_cells("3456")
GRADE_1_INDICATOR = _parse_cells("56")
"""Precedes a lower-case a…j that follows a number and would otherwise be read as a digit."""

_ALPHABET = _parse_cells(
    "1 12 14 145 15 124 1245 125 24 245 13 123 134 1345 135 1234 12345 1235 234 2345 136 1236 2456 1346 13456 1356"
)
LETTERS = dict(zip(ascii_lowercase, _ALPHABET, strict=True))
DIGITS = {digit: LETTERS[letter] for digit, letter in zip("1234567890", "abcdefghij", strict=True)}
OPENING_QUOTE, CLOSING_QUOTE = _parse_cells("236"), _parse_cells("356")
PUNCTUATION = {
    ",": _parse_cells("2"),
    ";": _parse_cells("23"),
    ":": _parse_cells("25"),
    ".": _parse_cells("256"),
    "!": _parse_cells("235"),
    "?": _parse_cells("236"),
    "'": _parse_cells("3"),
    "’": _parse_cells("3"),
    "-": _parse_cells("36"),
    "–": _parse_cells("6 36"),
    "—": _parse_cells("6 36"),
    "/": _parse_cells("456 34"),
    "(": _parse_cells("5 126"),
    ")": _parse_cells("5 345"),
    "“": OPENING_QUOTE,
    "”": CLOSING_QUOTE,
    "+": _parse_cells("5 235"),
    "=": _parse_cells("5 2356"),
    "%": _parse_cells("46 356"),
    "&": _parse_cells("4 12346"),
}
"""Punctuation except the upright double quote, which opens at the start of a word and closes elsewhere."""

LETTER_RUN = re.compile("[A-Za-z]+")
_SUPPORTED_CHARACTERS = frozenset(ascii_letters) | DIGITS.keys() | PUNCTUATION.keys() | frozenset('" \t\r\n')


def encode_lines(text: str, where: str) -> list[list[list[Cell]]]:
    """Encode text as lines of words of cells. Lines end at line breaks only.

    Raises InputError (bad_text) for a character without a cell.
    """
    for position, character in enumerate(text, start=1):
        if character not in _SUPPORTED_CHARACTERS:
            name = unicodedata.name(character, f"U+{ord(character):04X}")
            expected = f"a–z, digits and common punctuation; character {position} is {name}"
            raise InputError(where, character, expected, code="bad_text")
    return [[encode_word(word) for word in line.split()] for line in text.split("\n")]


def encode_word(word: str) -> list[Cell]:
    """Encode one word of supported characters, with its number, capital and letter indicators."""
    cells: list[Cell] = []
    in_number, runs = False, _find_capital_runs(word)
    for position, character in enumerate(word):
        if character in DIGITS:
            cells += () if in_number else NUMERIC_INDICATOR
            cells.append(DIGITS[character])
            in_number = True
        elif character in ".," and (in_number or (position == 0 and word[1:2].isdigit())):
            cells += () if in_number else NUMERIC_INDICATOR
            cells += PUNCTUATION[character]
            in_number = True
        elif character in ascii_letters:
            cells += _select_letter_indicators(character, position, in_number, runs)
            cells.append(LETTERS[character.lower()])
            in_number = False
        else:
            cells += _encode_punctuation(word, position)
            in_number = False
    return cells


def _find_capital_runs(word: str) -> dict[int, int]:
    """Return the start of the run of each letter that stands in a run of two or more letters, all of them capitals."""
    runs = (run for run in LETTER_RUN.finditer(word) if run.end() - run.start() >= 2 and run[0].isupper())
    return {position: run.start() for run in runs for position in range(run.start(), run.end())}


def _select_letter_indicators(letter: str, position: int, in_number: bool, runs: dict[int, int]) -> tuple[Cell, ...]:
    """Return the indicators before a letter. One word indicator covers a whole run of capitals."""
    if letter.islower():
        return GRADE_1_INDICATOR if in_number and letter in "abcdefghij" else ()
    if position in runs:
        return CAPITAL_WORD_INDICATOR if position == runs[position] else ()
    return CAPITAL_LETTER_INDICATOR


def _encode_punctuation(word: str, position: int) -> tuple[Cell, ...]:
    character = word[position]
    if character == '"':
        return OPENING_QUOTE if position == 0 else CLOSING_QUOTE
    return PUNCTUATION[character]


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
METADATA = re.compile(r"^#([-+][a-z-]+):\s*(.*?)\s*$", re.MULTILINE)
METADATA_MAX = 4_000
"""Characters at a table's beginning among which its metadata stand."""
ALL_LANGUAGES = "all"
_lock = Lock()


class TranslationTable(NamedTuple):
    """A table as it describes itself: dots and contraction are empty where it does not say."""

    table: str
    language: str
    name: str
    dots: str
    contraction: str


def translate_lines(text: str, table: str, where: str) -> list[list[list[Cell]]]:
    """Translate text into lines of words of six-dot cells. Lines end at line breaks only.

    table: name of a liblouis table, such as en-ueb-g2. Raises InputError for an unknown table, one of eight dots
    (bad_table), a character that it does not know (bad_text), and without the library (missing_library).
    """
    place = f"{where.rpartition(': ')[0] or where}: table"
    library, file = _load_library(place), _find_table(table, place)
    lines = [" ".join(line.split()) for line in text.split("\n")]
    try:
        return [_split_words(_translate(library, file, line, where)) for line in lines]
    except InputError as error:
        if error.code != "bad_table":
            raise
    # A table may lack a character, or write it with dots 7 and 8; the whole text tells of its context, so ask alone.
    for character in dict.fromkeys("".join(lines)):
        try:
            _translate(library, file, character, where)
        except InputError:
            named = f"{unicodedata.name(character, 'a character')} (U+{ord(character):04X})"
            expected = f"characters that {Path(file.decode()).name} writes in six dots; this is {named}"
            expected += _suggest_six_dots(table)
            raise InputError(where, character, expected, code="bad_text") from None
    raise InputError(place, table, f"a table of six dots{_suggest_six_dots(table)}", code="bad_table")


@cache
def _load_library(where: str) -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(LIBRARY)
    except OSError:
        expected = "liblouis: apt-get install liblouis20 liblouis-data; without a table, text is uncontracted English"
        raise InputError(where, MISSING, expected, code="missing_library") from None
    library.lou_setLogLevel(NO_LOG)
    return library


def _find_table(table: str, where: str) -> bytes:
    """Return the file of a table. Names are plain: a caller of the daemon must not open files of its choice."""
    known = sorted(path.name for path in TABLES.glob("*") if path.suffix in SUFFIXES)
    if NAME.fullmatch(table):
        for name in (table, *(table + suffix for suffix in SUFFIXES)):
            if name in known:
                return str(TABLES / name).encode()
    stems = sorted({name.rpartition(".")[0] for name in known})
    near = suggest_near_name(table, stems)
    expected = f"a table in {TABLES}, {near or 'such as en-ueb-g2'}; `optodrive patterns --tables all` lists them"
    raise InputError(where, table, expected, code="bad_table")


def list_tables(language: str) -> list[TranslationTable]:
    """List the tables that state a language, those of one language by its code or all, by language and name."""
    found = []
    for path in TABLES.glob("*"):
        if path.suffix not in SUFFIXES:
            continue
        stated = dict(METADATA.findall(path.read_text(encoding="utf-8", errors="replace")[:METADATA_MAX]))
        own = stated.get("+language", "")
        if own and language in (ALL_LANGUAGES, own, own.partition("-")[0]):
            name = stated.get("-display-name") or stated.get("-index-name") or stated.get("-name", "")
            table = path.stem if len(list(TABLES.glob(f"{path.stem}.*"))) == 1 else path.name
            found.append(TranslationTable(table, own, name, stated.get("+dots", ""), stated.get("+contraction", "")))
    return sorted(found, key=lambda table: (table.language, table.table))


def _suggest_six_dots(table: str) -> str:
    """Return a phrase with a table of six dots for the language of a table that has eight, or an empty text."""
    language = re.split(r"[-_.]", table)[0].lower()
    known = list_tables(language)
    if not any(each.table == table and each.dots == "8" for each in known):
        return ""
    six = [each for each in known if each.dots == "6" and each.table.startswith(language)]
    best = min(six, key=lambda each: each.contraction != "no", default=None)
    return f"; {best.table} ({best.name}) has six" if best else ""


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
        raise InputError(where, line, f"text that {Path(file.decode()).name} translates", code="bad_text")
    cells = list[Cell]()
    for character in result.raw[: written.value * width].decode(encoding):
        if not FIRST_CELL <= ord(character) <= LAST_SIX_DOT_CELL:
            expected = f"a table of six dots, not {Path(file.decode()).name}"
            raise InputError(where, character, expected, code="bad_table")
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
