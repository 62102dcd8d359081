"""Every line of the threat model names a test; scripts/check looks the names up."""

import re

from pages import ROOT


def find_untested(text):
    """Return the lines of the table that name no test."""
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    assert rows
    return [row for row in rows if not re.search(r"`tests/[\w/]+\.py::\w+`", row.rsplit(" | ", 1)[1])]


def test_every_threat_has_its_test():
    text = (ROOT / "docs/explanation/threat-model.md").read_text()
    assert find_untested(text) == []
    untested = "| a threat | an answer | by reading |"
    assert find_untested(f"{text}{untested}\n") == [untested]
