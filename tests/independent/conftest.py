"""Imports of the conformance suite, and the interpreter of the programs in JavaScript."""

import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
sys.path.insert(0, str(TESTS / "conformance"))
sys.path.append(str(TESTS / "pico"))
pytest.register_assert_rewrite(
    *(f"{name}_scenarios" for name in ("edge", "guard", "job", "link", "order", "self", "trust"))
)
