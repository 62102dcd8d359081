"""Every test that went to the nightly run exists, and so does the test of the gate that covers it."""

import re
import sys
from pathlib import Path

import pytest

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


def test_every_slow_file_is_in_one_piece():
    files = [file for piece in slow.list_pieces().values() for file in piece]
    assert len(files) == len(set(files))
    assert {name.partition("::")[0] for name in NIGHTLY} <= set(files)


def test_the_piece_that_is_due_is_the_one_without_a_row_or_with_the_oldest():
    rows = [{"piece": name} for name in ("a", "b", "a")]
    assert slow.choose_piece(["a", "b", "c"], rows) == "c"
    assert slow.choose_piece(["a", "b"], rows) == "b"
