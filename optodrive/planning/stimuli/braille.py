"""Encoder of text in uncontracted braille cells (Unified English Braille, grade 1).

A cell is the set of its raised dots. Dots 1, 2, 3 run down the left column, 4, 5, 6 down the right one.
"""

import re
import unicodedata
from string import ascii_letters, ascii_lowercase

from optodrive.core.errors import InputError

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
