"""Every test that went to the nightly run exists, and so does the test of the gate that covers it."""

import re
import subprocess
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


def test_every_folder_with_tests_has_pieces():
    folders = {path.relative_to(ROOT / "tests").parts[0] for path in (ROOT / "tests").rglob("test_*.py")}
    assert folders == set(slow.FOLDERS)


def test_pieces_are_all_of_the_tests_once():
    command = [
        sys.executable,
        "-m",
        "pytest",
        "--collect-only",
        "-q",
        "tests/unit/core/test_quantity.py",
        "-m",
        "not slow",
    ]

    def list_tests(piece):
        said = subprocess.run([*command, "--piece", piece], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        return [line for line in said.splitlines() if "::" in line]

    whole = list_tests("1/1")
    assert len(whole) > 30
    assert [test for k in (1, 2, 3) for test in list_tests(f"{k}/3")] == whole


def test_the_piece_that_is_due_is_the_one_without_a_row_or_with_the_oldest():
    rows = [{"piece": name} for name in ("a", "b", "a")]
    assert slow.choose_piece(["a", "b", "c"], rows) == "c"
    assert slow.choose_piece(["a", "b"], rows) == "b"
