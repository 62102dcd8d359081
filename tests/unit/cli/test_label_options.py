"""Labels on the command line."""

import pytest

from optodrive.cli.play import parse_label_options
from optodrive.core.errors import InputError


def test_values_are_numbers_true_or_text():
    assert parse_label_options(["trial=3", "gain=0.5", "is_left=true", "who=anna", "list=[1]"]) == {
        "trial": 3,
        "gain": 0.5,
        "is_left": True,
        "who": "anna",
        "list": "[1]",
    }


def test_a_value_that_nests_too_deep_is_refused_as_text():
    with pytest.raises(InputError, match=r"--label\.a: .*expected text of at most 256 printable characters"):
        parse_label_options(["a=" + "[" * 100_000])
