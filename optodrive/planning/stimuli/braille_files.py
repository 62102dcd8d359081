"""Frames from braille that was translated elsewhere: BRF (braille ASCII) and PEF (the Portable Embosser Format).

A file of plain text is translated as the pattern `text` does. It is known by letters of both cases, of which braille
ASCII has one, or by a character that braille ASCII does not have.
"""

import codecs
import re
from string import ascii_lowercase, ascii_uppercase
from typing import Literal
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from optodrive.core.errors import InputError, Unquoted, build_nothing_raised_error
from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config
from optodrive.planning.stimuli.braille import Cell
from optodrive.planning.stimuli.pixel_lattice import Spacing
from optodrive.planning.stimuli.text import PAGES_MAX, Lines, show_pages, translate

FileFormat = Literal["auto", "braille", "text"]
"""What a file holds: braille, text, or what its content says."""
BRAILLE_ASCII = " A1B'K2L@CIF/MSP\"E3H9O6R^DJG>NTQ,*5<-U8V.%[$+X!&;:4\\0Z7(_?W]#Y)="
"""The character of each cell, by its dots as bits, dot 1 lowest (North American Braille Computer Code)."""
ONE_CASE = str.maketrans(ascii_lowercase + "`{|}~\t", ascii_uppercase + "@[\\]^ ")
"""The characters of ASCII's last columns, which stand for the same cells as those before them."""
PEF = "{http://www.daisy.org/ns/2008/pef}"
FIRST_CELL, LAST_SIX_DOT_CELL = 0x2800, 0x283F
MARKUP_STARTS, MARKUP_END = ("<?xml", "<pef", "<!"), ">"
CPM_END = "\x1a"
CHARACTERS_MAX = 500_000
"""Characters of a file: twice a volume of braille."""
TAGS_MAX = 100_000
"""Tags of a PEF file: two volumes in rows of a few cells."""
SPACING = Spacing(dot_step=1, cell_gap=1, line_gap=1)


def build_braille_file(
    config: Config,
    where: str,
    file: bytes,
    height_m: float,
    seconds: float,
    format: FileFormat = "auto",
    table: str | None = None,
    start_page: int = 1,
    pages: int | None = None,
) -> FrameSequence:
    """Build the pages of a BRF or PEF file, or of text, wrapped at words into the display's lines, each for `seconds`.

    format: what the file holds; table: of liblouis, for text; start_page: first page of the file, from 1, that is
    shown; pages: how many of them, None for all from there. Raises InputError (bad_text, does_not_fit, too_many,
    raises_nothing, bad_parameter, and with a table bad_table, missing_library).
    """
    place = f"{where}: file"
    if len(file) > 4 * CHARACTERS_MAX:
        raise InputError(place, Unquoted(f"{len(file)} bytes"), f"at most {4 * CHARACTERS_MAX}", code="too_many")
    if format != "text" and _is_markup(file):
        found = [[_split_words(row) for row in page] for page in _read_pef(file, place)]
    else:
        text = _decode(file, place).replace("\r\n", "\n").replace("\r", "\n").rstrip(CPM_END)
        if len(text) > CHARACTERS_MAX or text.count("\f") >= PAGES_MAX:
            size = Unquoted(f"{len(text)} characters, {text.count(chr(12)) + 1} pages")
            raise InputError(place, size, f"at most {CHARACTERS_MAX} characters, {PAGES_MAX} pages", code="too_many")
        if format == "text" or (format == "auto" and _is_text(text)):
            found = [translate(page, table, place) for page in text.split("\f")]
        else:
            found = [[_split_words(row) for row in page] for page in _read_brf(text, place)]
    if start_page > max(1, len(found)):
        expected = f"a page of the file, 1 to {len(found)}"
        raise InputError(f"{where}: start_page", start_page, expected, code="bad_parameter")
    chosen = found[start_page - 1 :][:pages]
    shown = [page for page in map(_strip_rows, chosen) if page]
    if not shown:
        raise build_nothing_raised_error(
            place,
            "all its pages are blank" if len(chosen) == len(found) else "the chosen pages are blank",
            "braille with at least one raised dot",
        )
    return show_pages(config, where, shown, height_m, seconds, SPACING)


def _is_markup(file: bytes) -> bool:
    """Return whether a file is XML, whose first and last characters braille may have too, but seldom both."""
    text = file.replace(b"\0", b"").decode("latin-1").lstrip("\xef\xbb\xbf\xff\xfe \t\r\n").rstrip()
    return text.startswith(MARKUP_STARTS) or (text.startswith("<") and text.endswith(MARKUP_END))


def _decode(file: bytes, where: str) -> str:
    """Return the text of a file in UTF-8 or UTF-16, with or without a mark. Raise InputError (bad_text)."""
    if file.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    else:
        encoding = "utf-16-le" if file[1:2] == b"\0" else "utf-16-be" if file[:1] == b"\0" else "utf-8-sig"
    try:
        return file.decode(encoding)
    except UnicodeDecodeError as error:
        row = file[: error.start].count(b"\n") + 1
        found = Unquoted(f"byte 0x{file[error.start]:02X}")
        expected = "braille ASCII, a PEF file, or text in UTF-8 or UTF-16"
        raise InputError(f"{where}: row {row}", found, expected, code="bad_text") from None


def _is_text(text: str) -> bool:
    """Return whether a file holds text in place of braille."""
    ascii_only = "".join(each for each in text if not FIRST_CELL <= ord(each) <= LAST_SIX_DOT_CELL)
    is_mixed = any(each in ascii_lowercase for each in text) and any(each in ascii_uppercase for each in text)
    return is_mixed or not ascii_only.isascii()


def _read_brf(text: str, where: str) -> list[list[str]]:
    """Return the rows of each page as characters of Unicode's braille block, which may stand in the file itself."""
    pages: list[list[str]] = []
    number = 0
    for page in text.split("\f"):
        pages.append([])
        for row in page.split("\n"):
            number += 1
            cells = ""
            for character in row.translate(ONE_CASE):
                if FIRST_CELL <= ord(character) <= LAST_SIX_DOT_CELL:
                    cells += character
                elif character in BRAILLE_ASCII:
                    cells += chr(FIRST_CELL + BRAILLE_ASCII.index(character))
                else:
                    expected = "braille ASCII, a PEF file, or format=text"
                    raise InputError(f"{where}: row {number}", character, expected, code="bad_text")
            pages[-1].append(cells)
    return pages


def _read_pef(file: bytes, where: str) -> list[list[str]]:
    """Return the rows of each page of a PEF file."""
    if file.count(b"<") > TAGS_MAX:
        raise InputError(where, Unquoted(f"{file.count(b'<')} tags"), f"at most {TAGS_MAX}", code="too_many")
    try:
        root: Element = fromstring(file, forbid_dtd=True)
    except DefusedXmlException:
        raise InputError(where, Unquoted("a document type"), "a PEF file without one", code="bad_text") from None
    except (ParseError, ValueError, LookupError) as error:  # an unknown encoding is none of the parser's own errors
        raise InputError(where, str(error), "a PEF file, which is well-formed XML", code="bad_text") from None
    if root.tag != f"{PEF}pef":
        raise InputError(where, root.tag[:80], f"the root element {PEF}pef", code="bad_text")
    pages: list[list[str]] = []
    number = 0
    for element in root.iter():  # once: pages and rows that hold others would be read over and over
        if element.tag == f"{PEF}page":
            pages.append([])
        elif element.tag == f"{PEF}row" and pages:
            number += 1
            text, place = (element.text or "").strip(), f"{where}: row {number}"
            if len(element):
                raise InputError(place, element[0].tag[:80], "cells alone in a row", code="bad_text")
            wrong = next((each for each in text if not FIRST_CELL <= ord(each) <= LAST_SIX_DOT_CELL), None)
            if wrong is not None:
                raise InputError(place, wrong, "cells of six dots, U+2800 to U+283F", code="bad_text")
            pages[-1].append(text)
    return pages


def _split_words(row: str) -> list[list[Cell]]:
    return [
        [frozenset(dot for dot in range(1, 7) if ord(cell) - FIRST_CELL >> (dot - 1) & 1) for cell in word]
        for word in re.split(chr(FIRST_CELL) + "+", row)
        if word
    ]


def _strip_rows(page: Lines) -> Lines:
    """Return a page without the empty rows at its end, with which files fill their pages."""
    last = max((number for number, row in enumerate(page, start=1) if row), default=0)
    return page[:last]
