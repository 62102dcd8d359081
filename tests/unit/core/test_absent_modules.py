"""Modules that a library does without while it is imported."""

import sys
from importlib import import_module

import pytest

from optodrive.core.extras import hide_modules


def test_a_module_is_hidden_unless_it_is_imported_already_and_only_for_a_while(monkeypatch):
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    with hide_modules("colorsys", "json"):
        assert import_module("json") is sys.modules["json"]
        with pytest.raises(ImportError):
            import_module("colorsys")
    assert import_module("colorsys").rgb_to_hsv(1.0, 1.0, 1.0) == (0.0, 0.0, 1.0)
