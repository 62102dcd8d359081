"""Random lines for tables of liblouis, and their cells by the library's own program."""

import random
import subprocess

from optodrive.planning.stimuli import braille

ALPHABETS = {
    "en-ueb-g1": "abcdefghijklmnopqrstuvwxyzABCXYZ0123456789,.;:!?-()'\"",
    "en-ueb-g2": "abcdefghijklmnopqrstuvwxyzABCXYZ0123456789,.;:!?-()'\"",
    "de-g1": "abcdefghijklmnopqrstuvwxyzäöüßÄÖÜ0123456789,.;:!?-()",
    "de-g2": "abcdefghijklmnopqrstuvwxyzäöüß0123456789,.;:!?-()",
    "fr-bfu-comp6": "abcdefghijklmnopqrstuvwxyzàâçéèêëîïôûù0123456789,.;:!?-()",
    "es-g1": "abcdefghijklmnopqrstuvwxyzáéíóúñü0123456789,.;:!?-()",
    "it-it-comp6": "abcdefghijklmnopqrstuvwxyzàèéìòù0123456789,.;:!?-()",
    "nl-NL-g0": "abcdefghijklmnopqrstuvwxyzëïé0123456789,.;:!?-()",
    "Pl-Pl-g1": "abcdefghijklmnopqrstuvwxyząćęłńóśźż0123456789,.;:!?-()",
    "pt-pt-g1": "abcdefghijklmnopqrstuvwxyzáâãàçéêíóôõú0123456789,.;:!?-()",
    "ru-litbrl": "абвгдежзийклмнопрстуфхцчшщъыьэюяАБВ0123456789,.;:!?-()",
}
"""Ten languages, and contracted English and German."""
ENGLISH = [
    "the",
    "and",
    "for",
    "with",
    "people",
    "ability",
    "know",
    "little",
    "under",
    "mother",
    "quick",
    "would",
    "braille",
]


def draw_lines(table, count):
    """Return lines of random words, in English half of them real ones, which have contractions."""
    rng = random.Random(table)
    words = lambda: "".join(rng.choices(ALPHABETS[table], k=rng.randint(1, 9)))  # noqa: E731
    real = lambda: rng.choice(ENGLISH) if table.startswith("en") and rng.random() < 0.5 else words()  # noqa: E731
    return [" ".join(real() for _ in range(rng.randint(1, 6))) for _ in range(count)]


def judge(table, lines):
    """Return the lines with their cells by liblouis's own program, as characters of Unicode's braille block.

    The German tables give a full stop after a figure a dot of liblouis's own, for which the program has no character of
    that block: such lines, at most one in a hundred, are left out.
    """
    (file,) = [path.name for path in braille.TABLES.glob(f"{table}.*") if path.suffix in braille.SUFFIXES]
    given = "".join(line + "\n" for line in lines)
    done = subprocess.run(
        ["lou_translate", f"unicode.dis,{file}"], input=given, capture_output=True, text=True, check=True
    )
    stated = zip(lines, done.stdout.split("\n"), strict=False)
    judged = [(line, cells) for line, cells in stated if all(is_cell(character) for character in cells)]
    assert len(judged) >= 0.99 * len(lines)
    return judged


def is_cell(character):
    """Return whether a character of the program's output is a cell, or the space between words."""
    return character == " " or 0x2800 <= ord(character) < 0x2900
