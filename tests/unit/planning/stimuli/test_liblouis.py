"""Text by tables of liblouis: the cells of `lou_translate`, on the pixels of the display; wrong input in one line."""

import ctypes
import unicodedata
from pathlib import Path
from shutil import which

import numpy as np
import pytest

from liblouis_judge import ALPHABETS, draw_lines, judge
from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli import braille
from optodrive.planning.stimuli.braille import LIBRARY, _find_table, list_tables, translate_lines
from optodrive.planning.stimuli.pixel_lattice import Lattice, Spacing, find_line_slots
from optodrive.planning.stimuli.text import build_text, translate


def has_library():
    try:
        ctypes.CDLL(LIBRARY)
    except OSError:
        return False
    return which("lou_translate") is not None


needs_library = pytest.mark.skipif(not has_library(), reason="liblouis is not installed: scripts/test-packages")


def to_unicode(words):
    return "\u2800".join("".join(chr(0x2800 + sum(1 << dot - 1 for dot in cell)) for cell in word) for word in words)


def check_table(table, count):
    lines, judged = zip(*judge(table, draw_lines(table, count)), strict=True)
    expected = ["\u2800".join(line.replace(" ", "\u2800").split("\u2800")).strip("\u2800") for line in judged]
    found = [to_unicode(words) for words in translate_lines("\n".join(lines), table, "text")]
    assert [row for row in zip(lines, found, expected, strict=True) if row[1] != row[2]] == []


@needs_library
@pytest.mark.parametrize("table", sorted(ALPHABETS))
def test_cells_are_those_of_the_librarys_own_program(table):
    check_table(table, 100)


@needs_library
@pytest.mark.slow
@pytest.mark.parametrize("table", sorted(ALPHABETS))
def test_a_thousand_strings_have_the_cells_of_the_librarys_own_program(table):
    check_table(table, 1000)


@needs_library
def test_the_cells_stand_on_the_display():
    config = load_config("display-1511")
    lines = draw_lines("en-ueb-g2", 12)
    frames = build_text(config, "t", "\n".join(lines), 1e-4, 0.0, table="en-ueb-g2").frames
    lattice = Lattice.from_config(config)
    slots = find_line_slots(lattice, Spacing(1, 1, 1))
    shown = []
    for target_m in dict.fromkeys(page.target_m.tobytes() for page in frames):
        raised = np.frombuffer(target_m) > 0.0
        for line in slots:
            cells = [frozenset(dot for dot, pixel in slot.items() if raised[pixel]) for slot in line]
            shown += to_unicode([cells]).strip("\u2800").split("\u2800")
    expected = [word for _, line in judge("en-ueb-g2", lines) for word in line.replace(" ", "\u2800").split("\u2800")]
    assert "".join(shown) == "".join(expected)


@needs_library
@pytest.mark.parametrize(
    ("text", "table", "message"),
    [
        ("a", "en-ueb-g9", "expected a table in .*, nearest is 'en-ueb-g"),
        ("a", "../../../etc/passwd", "expected a table in .*, such as en-ueb-g2"),
        ("a", "en-ueb-g2.ctb,de-g1.ctb", "expected a table in"),
        ("a", "", "expected a table in"),
        ("Ä", "de-de-comp8", "got 'Ä', .* de-de-comp8.ctb writes in six dots; .*; de-.* has six"),
        (
            "x",
            "ru",
            r"ru.ctb writes in six dots; this is LATIN SMALL LETTER X .*; ru-litbrl \(Russian braille\) has six",
        ),
        ("a 😀", "en-ueb-g2", r"got '😀', .*this is GRINNING FACE \(U\+1F600\)$"),
        ("ä漢", "de-g1", "got '漢', .*this is CJK UNIFIED IDEOGRAPH-6F22"),
        ("a", "rus", "nearest is 'ru'; `optodrive patterns --tables all` lists them"),
    ],
)
def test_a_wrong_table_is_refused_in_one_line(text, table, message):
    with pytest.raises(InputError, match=message) as refused:
        translate_lines(text, table, "text")
    assert "\n" not in str(refused.value)


@needs_library
@pytest.mark.parametrize(("table", "text"), [("de-g1", "Grüße"), ("fr-bfu-comp6", "été"), (None, "a")])
def test_decomposed_letters_have_the_cells_of_composed_ones(table, text):
    cells = [translate(unicodedata.normalize(form, text), table, "t: text") for form in ("NFC", "NFD")]
    assert cells[0] == cells[1] != [[]]


@needs_library
def test_tables_are_listed_by_language(capsys):
    tables = {each.table: each for each in list_tables("ru")}
    assert {each.language for each in tables.values()} == {"ru"}
    assert tables["ru-litbrl"].dots == "6"
    assert set(tables) < {each.table for each in list_tables("all")}
    for name in tables:
        _find_table(name, "t")
    assert run(["patterns", "--tables", "ru"]) == 0
    assert "ru-litbrl                    ru       6 dots  Russian braille\n" in capsys.readouterr().out
    assert run(["patterns", "--tables", "xx"]) == 2
    assert "expected all, or the code of a language" in capsys.readouterr().err


def test_without_the_library_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(braille, "LIBRARY", "liblouis-that-is-missing.so")
    braille._load_library.cache_clear()
    try:
        with pytest.raises(InputError, match=r"t: table: .*apt-get install liblouis20 liblouis-data") as refused:
            translate_lines("a", "en-ueb-g2", "t")
        assert refused.value.code == "missing_library"
    finally:
        braille._load_library.cache_clear()


def test_the_tables_folder_is_debians():
    assert Path("/usr/share/liblouis/tables") == braille.TABLES
