"""The generated reference pages are current."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "scripts"))

from reference_pages import FOLDER, PAGES  # noqa: E402 - beside the path above


@pytest.mark.parametrize("name", PAGES)
def test_a_generated_page_is_current(name):
    if (FOLDER / name).read_text(encoding="utf-8") != PAGES[name]():
        pytest.fail(f"docs/reference/{name} is not current: run scripts/reference")


def test_every_configuration_key_is_described():
    rows = [line for line in PAGES["configuration.md"]().splitlines() if line.startswith("- `")]
    assert rows
    assert [row for row in rows if row.endswith(": ")] == []
