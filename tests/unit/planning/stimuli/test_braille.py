"""Braille encoding against the code table of Unified English Braille."""

import pytest

from optodrive.core.errors import InputError
from optodrive.planning.stimuli.braille import encode_lines, encode_word


def to_unicode_braille(text):
    """Return cells as characters of the Unicode braille block, dot n on bit n - 1."""
    return " ".join(
        "".join(chr(0x2800 + sum(1 << dot - 1 for dot in cell)) for cell in encode_word(w)) for w in text.split()
    )


@pytest.mark.parametrize(
    ("text", "braille"),
    [
        ("abcdefghij", "⠁⠃⠉⠙⠑⠋⠛⠓⠊⠚"),
        ("klmnopqrst", "⠅⠇⠍⠝⠕⠏⠟⠗⠎⠞"),
        ("uvwxyz", "⠥⠧⠺⠭⠽⠵"),
        ("1234567890", "⠼⠁⠃⠉⠙⠑⠋⠛⠓⠊⠚"),
        ("Hello, world!", "⠠⠓⠑⠇⠇⠕⠂ ⠺⠕⠗⠇⠙⠖"),
        ("Is it? Yes; no: wait.", "⠠⠊⠎ ⠊⠞⠦ ⠠⠽⠑⠎⠆ ⠝⠕⠒ ⠺⠁⠊⠞⠲"),
        ("don't re-do", "⠙⠕⠝⠄⠞ ⠗⠑⠤⠙⠕"),
        ("don’t", "⠙⠕⠝⠄⠞"),
        ("(a/b)", "⠐⠣⠁⠸⠌⠃⠐⠜"),
        ('"Oh!" “no”', "⠦⠠⠕⠓⠖⠴ ⠦⠝⠕⠴"),
        ("NASA A Ab aB TVs", "⠠⠠⠝⠁⠎⠁ ⠠⠁ ⠠⠁⠃ ⠁⠠⠃ ⠠⠞⠠⠧⠎"),
        ("X-RAY", "⠠⠭⠤⠠⠠⠗⠁⠽"),
        ("5,000.25 kg", "⠼⠑⠂⠚⠚⠚⠲⠃⠑ ⠅⠛"),
        (".5", "⠼⠲⠑"),
        ("3-4 3a 3k 3A", "⠼⠉⠤⠼⠙ ⠼⠉⠰⠁ ⠼⠉⠅ ⠼⠉⠠⠁"),
        ("a1b", "⠁⠼⠁⠰⠃"),
        ("1+2=3", "⠼⠁⠐⠖⠼⠃⠐⠶⠼⠉"),
        ("5% & – —", "⠼⠑⠨⠴ ⠈⠯ ⠠⠤ ⠠⠤"),
    ],
)
def test_text_is_written_as_in_unified_english_braille(text, braille):
    assert to_unicode_braille(text) == braille


def test_lines_end_at_line_breaks_and_words_at_blanks():
    lines = encode_lines("a  b\tc\r\n\nd", "text")
    assert [len(words) for words in lines] == [3, 0, 1]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "naïve",
            "text: got 'ï', expected a–z, digits and common punctuation; character 3 is LATIN SMALL LETTER I WITH",
        ),
        ("a€", "character 2 is EURO SIGN"),
        ("٣", "ARABIC-INDIC DIGIT THREE"),
        ("\u212a", "KELVIN SIGN"),
        ("a\x00", "character 2 is U+0000"),
        ("{", "LEFT CURLY BRACKET"),
    ],
)
def test_a_character_without_a_cell_is_named(text, says):
    with pytest.raises(InputError) as caught:
        encode_lines(text, "text")
    assert caught.value.code == "bad_text"
    assert says in str(caught.value)
