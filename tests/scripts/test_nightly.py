"""Every test that went to the nightly run exists, and so does the test of the gate that covers it."""

import re
import sys
from pathlib import Path

import pytest

from pieces import take_piece

sys.path.append(str(Path(__file__).parents[2] / "scripts"))

import slow

ROOT = Path(__file__).parents[2]
NIGHTLY = slow.read_nightly()


def exists(name):
    file, _, test = name.partition("[")[0].partition("::")
    path = ROOT / file
    return path.is_file() and (not test or re.search(rf"^(async )?def {test}", path.read_text(), re.MULTILINE))


@pytest.mark.parametrize("name", NIGHTLY)
def test_a_nightly_test_and_what_covers_it_exist(name):
    cover = NIGHTLY[name]
    assert exists(name)
    assert exists(cover)
    assert not cover.startswith(tuple(NIGHTLY)), "what covers it is in the gate"


def test_every_folder_with_tests_has_pieces():
    folders = {path.relative_to(ROOT / "tests").parts[0] for path in (ROOT / "tests").rglob("test_*.py")}
    assert folders == set(slow.FOLDERS)


@pytest.mark.parametrize(("tests", "count"), [(37, 3), (6, 6), (2, 5), (0, 1)])
def test_pieces_are_all_of_the_tests_once_and_in_order(tests, count):
    pieces = [take_piece(list(range(tests)), f"{k}/{count}") for k in range(1, count + 1)]
    assert [test for piece in pieces for test in piece] == list(range(tests))
    assert max(map(len, pieces)) - min(map(len, pieces)) <= 1


def test_the_piece_that_is_due_is_the_one_without_a_row_or_with_the_oldest():
    rows = [{"piece": name} for name in ("a", "b", "a")]
    assert slow.choose_piece(["a", "b", "c"], rows) == "c"
    assert slow.choose_piece(["a", "b"], rows) == "b"
