"""Imports of the conformance suite, and the interpreter of the programs in JavaScript."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "conformance"))
pytest.register_assert_rewrite(
    *(f"{name}_scenarios" for name in ("edge", "guard", "job", "link", "order", "self", "trust"))
)
