"""Frames from braille that was translated elsewhere: BRF (braille ASCII) and PEF (the Portable Embosser Format)."""

import re
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config
from optodrive.planning.stimuli.braille import Cell
from optodrive.planning.stimuli.cell_slots import Spacing
from optodrive.planning.stimuli.text import show_lines

BRAILLE_ASCII = " A1B'K2L@CIF/MSP\"E3H9O6R^DJG>NTQ,*5<-U8V.%[$+X!&;:4\\0Z7(_?W]#Y)="
"""The character of each cell, by its dots as bits, dot 1 lowest (North American Braille Computer Code)."""
NOT_MARKUP = b"\xef\xbb\xbf\xff\xfe\0 \t\r\n"
"""Bytes that may precede markup in UTF-8 and UTF-16."""
PEF = "{http://www.daisy.org/ns/2008/pef}"
FIRST_CELL, LAST_SIX_DOT_CELL = 0x2800, 0x283F


def build_braille_file(config: Config, where: str, file: bytes, height_m: float, seconds: float) -> FrameSequence:
    """Build the pages of a BRF or PEF file, wrapped at words into the display's lines, each for `seconds`.

    Raises InputError (bad_text, does_not_fit).
    """
    rows = (
        _read_pef(file, f"{where}: file") if file.lstrip(NOT_MARKUP)[:1] == b"<" else _read_brf(file, f"{where}: file")
    )
    lines = [[word for word in _split_words(row) if word] for row in rows]
    if not any(lines):
        raise InputError(f"{where}: file", "no cell", "braille with at least one raised dot", code="bad_text")
    return show_lines(config, where, lines, height_m, seconds, Spacing(dot_step=1, cell_gap=1, line_gap=1))


def _read_brf(file: bytes, where: str) -> list[str]:
    """Return the rows of a BRF file as characters of Unicode's braille block."""
    rows = []
    for number, row in enumerate(re.split(rb"\r\n|[\r\n\f]", file), start=1):
        text = row.decode("latin-1").upper().rstrip("\x1a ")
        wrong = next((character for character in text if character not in BRAILLE_ASCII), None)
        if wrong is not None:
            raise InputError(f"{where}: row {number}", wrong, "braille ASCII, or a PEF file", code="bad_text")
        rows.append("".join(chr(FIRST_CELL + BRAILLE_ASCII.index(character)) for character in text))
    return rows


def _read_pef(file: bytes, where: str) -> list[str]:
    """Return the rows of a PEF file."""
    try:
        root = fromstring(file, forbid_dtd=True)
    except DefusedXmlException:
        raise InputError(where, Unquoted("a document type"), "a PEF file without one", code="bad_text") from None
    except (ParseError, ValueError, LookupError) as error:  # an unknown encoding is none of the parser's own errors
        raise InputError(where, str(error), "a PEF file, which is well-formed XML", code="bad_text") from None
    if root.tag != f"{PEF}pef":
        raise InputError(where, root.tag[:80], f"the root element {PEF}pef", code="bad_text")
    rows = []
    for number, row in enumerate(root.iter(f"{PEF}row"), start=1):
        text = "".join(row.itertext()).strip()
        wrong = next((each for each in text if not FIRST_CELL <= ord(each) <= LAST_SIX_DOT_CELL), None)
        if wrong is not None:
            raise InputError(f"{where}: row {number}", wrong, "cells of six dots, U+2800 to U+283F", code="bad_text")
        rows.append(text)
    return rows


def _split_words(row: str) -> list[list[Cell]]:
    return [
        [frozenset(dot for dot in range(1, 7) if ord(cell) - FIRST_CELL >> (dot - 1) & 1) for cell in word]
        for word in row.split(chr(FIRST_CELL))
    ]
