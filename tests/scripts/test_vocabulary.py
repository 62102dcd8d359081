"""The vocabulary check finds retired words where they matter, and only there."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "scripts"))

from vocabulary import (
    c_names,
    find_phrases,
    find_vague_docstrings,
    load_phrases,
    load_retired,
    python_names,
    split_words,
    toml_names,
)

FOR_EVER = " ".join(("for", "ever"))
RETIRED = load_retired('[names]\nterm = ["standing_on", "=Basis", "tick()"]\n[phrases]\nkept = ["kept"]\n')


def find(names):
    return [RETIRED.find(name) for name in names if RETIRED.find(name)]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("link_up", ("link", "up")),
        ("LinkUp", ("link", "up")),
        ("LINK_UP2", ("link", "up", "2")),
        ("PWMCode", ("pwm", "code")),
    ],
)
def test_words_of_an_identifier(name, words):
    assert split_words(name) == words


@pytest.mark.parametrize(
    "source",
    [
        "standing_on = 1",
        "def f(standing_on): ...",
        "class StandingOn: ...",
        "self.now_standing_on = 1",
        "f(standing_on=1)",
        "{'standing_on': 1}",
        "x['standing_on']",
        "def tick(): ...",
        "class Basis: ...",
    ],
)
def test_a_retired_word_in_python_is_found(source):
    assert find(python_names("x.py", source))


@pytest.mark.parametrize(
    "source",
    [
        "discrepancy_basis = 1",
        "tick = 1",
        "'standing_on the pixel'",
        "# standing_on",
        "outstanding_on = 1",
        "def test_the_mirror_standing_on_a_pixel(): ...",
        "kept = 1",
    ],
)
def test_what_is_not_retired_is_not_found(source):
    assert not find(python_names("tests/x.py", source))


def test_c_identifiers_without_comments_and_strings():
    assert find(c_names("x.c", "int standing_on;"))
    assert not find(c_names("x.c", '/* standing_on */ char *t = "standing_on"; // standing_on\n'))


def test_toml_keys_at_every_depth():
    assert find(toml_names("x.toml", "[a]\nb = [{standing_on = 1}]"))
    assert not find(toml_names("x.toml", 'a = "standing_on"'))


PHRASES = load_phrases(f'[names]\nterm = ["kept"]\n[phrases]\ncompute = ["{FOR_EVER}", "deem"]\n')


@pytest.mark.parametrize(("text", "count"), [(f"it goes on {FOR_EVER}", 1), ("Deemed anew", 1), ("forever kept", 0)])
def test_a_retired_phrase_is_found_in_any_text(text, count):
    assert len(list(find_phrases("x.md", text, PHRASES))) == count


@pytest.mark.parametrize(
    ("docstring", "count"),
    [
        ("The thermal state of a display.", 0),
        ("The thermal state of a display", 1),
        ("The thermal state; and more.", 1),
        ("What a display does.", 1),
    ],
)
def test_the_first_line_of_a_module_is_one_plain_sentence(docstring, count):
    assert len(list(find_vague_docstrings("x.py", f'"""{docstring}"""'))) == count


@pytest.mark.parametrize("head", ["def f():", "async def f():", "class F:", "class F:\n    def f(self):"])
def test_the_docstrings_of_functions_and_classes_are_checked_too(head):
    indent = "        " if "\n" in head else "    "
    (problem,) = find_vague_docstrings("x.py", f'{head}\n{indent}"""Return x; raise y."""\n')
    assert problem.endswith("'Return x; raise y.' is not one plain sentence")
