"""CSV tables: cells that a spreadsheet would run."""

import pytest

from optodrive.core.numeric_tables import escape_formula


@pytest.mark.parametrize(
    "cell", ["=1+1", '=HYPERLINK("http://a")', "+A1", "-A1", "@SUM(1)", "\t=1", "\r=1", "--1", "=="]
)
def test_a_formula_gets_an_apostrophe(cell):
    assert escape_formula(cell) == f"'{cell}"


@pytest.mark.parametrize("cell", ["", "a=1", "-", "+", "-1.5", "+1e-3", " =1", -1.5, None, True])
def test_other_text_and_numbers_stay(cell):
    assert escape_formula(cell) is cell
