"""BRF and PEF files: the cells that they state, on the display's lines; wrong files in one line."""

import subprocess

import numpy as np
import pytest

from optodrive.cli.push_options import parse_parameters
from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli.braille import TABLES
from optodrive.planning.stimuli.braille_files import BRAILLE_ASCII, build_braille_file
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.planning.stimuli.pixel_lattice import Lattice, Spacing, find_line_slots
from optodrive.planning.stimuli.text import build_text

PEF = (
    '<?xml version="1.0" encoding="UTF-8"?><pef version="2008-1" xmlns="http://www.daisy.org/ns/2008/pef"><head/>'
    '<body><volume cols="40" rows="25" rowgap="0" duplex="true"><section>{}</section></volume></body></pef>'
)

DOCUMENT_TYPES = [
    f'<?xml version="1.0" encoding="{name}"?><!DOCTYPE pef [<!ENTITY a "⠃">]><pef>&a;</pef>'.encode(codec)
    for name, codec in (("UTF-8", "utf-8"), ("UTF-16", "utf-16"), ("UTF-16", "utf-16-le"), ("UTF-16", "utf-16-be"))
]
"""In UTF-16 with and without a byte order mark, which hides the letters from a search for bytes."""


def read_cells(sequence, name="display-1511"):
    """Return the cells of all pages, as characters of Unicode's braille block without spaces."""
    slots = find_line_slots(Lattice.from_config(load_config(name)), Spacing(1, 1, 1))
    cells = ""
    for page in dict.fromkeys(frame.target_m.tobytes() for frame in sequence.frames):
        raised = np.frombuffer(page) > 0.0
        for line in slots:
            cells += "".join(chr(0x2800 + sum(1 << dot - 1 for dot in slot if raised[slot[dot]])) for slot in line)
    return cells.replace("\u2800", "")


def show(file, name="display-1511"):
    return build_braille_file(load_config(name), "t", file, 1e-4, 1.0)


def test_braille_ascii_has_each_cell_once():
    assert len(set(BRAILLE_ASCII)) == len(BRAILLE_ASCII) == 64


@pytest.mark.skipif(not TABLES.exists(), reason="liblouis is not installed: scripts/test-packages")
def test_braille_ascii_is_that_of_liblouis():
    lines = (TABLES / "en-us-brf.dis").read_text().splitlines()
    for character, dots in (line.split()[1:3] for line in lines if line.startswith("display ")):
        value = sum(1 << int(dot) - 1 for dot in dots.replace("0", ""))
        if value < 64 and not character.startswith("\\x") and character.upper() == character:
            assert BRAILLE_ASCII[value] == character.replace("\\s", " ").replace("\\\\", "\\")


def test_a_brf_file_has_the_cells_of_its_characters():
    page = ",HELLO _W4\r\n#ABC 6/7\x0c,NEXT PAGE\x1a"
    expected = [BRAILLE_ASCII.index(each) for each in page.replace("\r\n", "").replace("\x0c", "").rstrip("\x1a")]
    assert read_cells(show(page.encode())) == "".join(chr(0x2800 + dots) for dots in expected if dots)
    assert read_cells(show(page.lower().encode())) == read_cells(show(page.encode()))


def test_a_pef_file_has_the_cells_of_its_rows():
    rows = ["⠠⠓⠑⠇⠇⠕⠀⠸⠺⠲", "", "⠼⠁⠃⠉⠀⠖⠌⠶"]
    section = "<page>" + "".join(f"<row>{row}</row>" for row in rows) + "</page><page><row>⠠⠝⠑⠭⠞</row></page>"
    assert read_cells(show(PEF.format(section).encode())) == "".join([*rows, "⠠⠝⠑⠭⠞"]).replace("\u2800", "")


def test_the_last_columns_of_ascii_stand_for_the_same_cells():
    assert read_cells(show(b"A`{|}~")) == read_cells(show(b"a@[\\]^"))
    assert len(read_cells(show(b"`{|}~"))) == 5


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-8"])
def test_a_file_may_have_a_mark_or_be_utf_16(encoding):
    expected = read_cells(show(b",HELLO\r\n_W4"))
    assert read_cells(show(",HELLO\r\n_W4".encode(encoding))) == expected
    cells = "".join(chr(0x2800 + BRAILLE_ASCII.index(each)) for each in ",HELLO _W4")
    if encoding in ("utf-8", "utf-8-sig", "utf-16"):  # cells alone do not tell which of UTF-16
        assert read_cells(show(cells.encode(encoding))) == expected
    pef = PEF.format(f"<page><row>{cells}</row></page>")
    declared = pef if encoding.startswith("utf-8") else pef.replace("UTF-8", "UTF-16")
    assert read_cells(show(declared.encode(encoding))) == expected


def count_pages(sequence):
    return len(dict.fromkeys(frame.target_m.tobytes() for frame in sequence.frames))


def test_a_page_of_the_file_begins_a_page_of_the_display():
    brf = b"A\nB\n\n\n\fC\n\n\f\n\n\fD\f"
    pef = PEF.format("".join(f"<page><row>{cell}</row><row/><row/></page>" for cell in ("⠁", "⠃", "", "⠉")))
    assert count_pages(show(brf)) == 3
    assert count_pages(show(pef.encode())) == 3
    assert count_pages(show(b"A\nB\nC")) == 1


@pytest.mark.parametrize("text", ["Hello, World.", "The end\nof it\fand More"])
def test_text_is_translated_and_not_played_as_braille_ascii(text):
    config = load_config("display-1511")
    shown = read_cells(show(text.encode()))
    assert shown == "".join(read_cells(build_text(config, "t", page, 1e-4, 1.0)) for page in text.split("\f"))
    assert count_pages(show(text.encode())) == len(text.split("\f"))


def test_the_name_of_a_text_file_says_what_it_holds(tmp_path):
    path = tmp_path / "notes.TXT"
    path.write_text("the end.")
    parameters = parse_parameters("play", "braille-file", [str(path)])
    assert parameters["format"] == "text"
    assert parse_parameters("play", "braille-file", [str(path), "format=braille"])["format"] == "braille"
    path.with_suffix(".brf").write_text("the end.")
    assert "format" not in parse_parameters("play", "braille-file", [str(path.with_suffix(".brf"))])
    shown = build_pattern("braille-file", parameters, load_config("display-1511"))
    assert read_cells(shown) == read_cells(build_text(load_config("display-1511"), "t", "the end.", 1e-4, 2.0))


@pytest.mark.skipif(not TABLES.exists(), reason="liblouis is not installed: scripts/test-packages")
def test_a_file_that_liblouis_wrote_has_its_cells():
    """Braille ASCII as its own program writes it, in lower case and with the last columns of ASCII."""
    text = "The People of Zürich {1}"
    command = ["lou_translate", "--forward", "en-us-brf.dis,en-ueb-g2.ctb"]
    said = subprocess.run(command, input=text + "\n", capture_output=True, text=True, check=True).stdout
    expected = build_text(load_config("display-1511"), "t", text, 1e-4, 1.0, table="en-ueb-g2")
    assert read_cells(show(said.encode())) == read_cells(expected)


def test_the_frames_are_those_of_the_same_text():
    config = load_config("display-437")
    shown = show(b"ABC DEF", "display-437")
    text = build_text(config, "t", "abc def", 1e-4, 1.0)
    assert [frame.target_m.tobytes() for frame in shown.frames] == [frame.target_m.tobytes() for frame in text.frames]


@pytest.mark.parametrize(
    ("file", "message"),
    [
        (b"", "braille with at least one raised dot"),
        (b" \r\n\x0c", "braille with at least one raised dot"),
        (
            "a\ncaf\u00e9".encode("latin-1"),
            r"file: row 2: got byte 0xE9, expected braille ASCII, a PEF file, or text in",
        ),
        (b"\xdf", "row 1: got byte 0xDF"),
        (b"A\nB\x7f", r"file: row 2: got '\\x7f', expected braille ASCII"),
        (b"Hello \xe6\xbc\xa2", "got '漢', expected a–z"),
        (b"<pef", "well-formed XML"),
        (b"<html></html>", "expected the root element {http://www.daisy.org/ns/2008/pef}pef"),
        *((text, "got a document type, expected a PEF file without one") for text in DOCUMENT_TYPES),
        (b'<?xml version="1.0" encoding="nonsense"?><pef/>', "well-formed XML"),
        (PEF.format("<page><row>ab</row></page>").encode(), r"file: row 1: got 'a', expected cells of six dots"),
        (PEF.format("<page><row>⡀</row></page>").encode(), "expected cells of six dots"),
    ],
)
def test_another_file_is_refused_in_one_line(file, message):
    with pytest.raises(InputError, match=message) as refused:
        show(file)
    assert "\n" not in str(refused.value)


def test_a_display_without_room_is_one_line():
    with pytest.raises(InputError, match="expected a display with 3 × 2 pixels for a cell"):
        show(b"ABC", "display-1")


THREE = {
    "braille": b"A\fB\fC",
    "text": b"a\fb\fc",
    "auto": PEF.format("".join(f"<page><row>{each}</row></page>" for each in "⠁⠃⠉")).encode(),
}


@pytest.mark.parametrize("kind", THREE)
@pytest.mark.parametrize(
    ("given", "cells"), [({}, "⠁⠃⠉"), ({"start_page": 2}, "⠃⠉"), ({"start_page": "2", "pages": "1"}, "⠃")]
)
def test_a_reader_begins_at_a_page_of_the_file(kind, given, cells):
    sequence = build_pattern(
        "braille-file", {"file": THREE[kind], "format": kind, **given}, load_config("display-1511")
    )
    assert read_cells(sequence) == cells


def test_a_page_that_the_file_has_not_or_that_is_blank_is_refused_in_one_line():
    def build(file, page):
        build_pattern("braille-file", {"file": file, "start_page": page, "pages": 1}, load_config("display-1511"))

    with pytest.raises(InputError, match=r"start_page: got 4, expected a page of the file, 1 to 3$"):
        build(THREE["braille"], 4)
    with pytest.raises(InputError, match="the chosen pages are blank"):
        build(b"A\f\fC", 2)
