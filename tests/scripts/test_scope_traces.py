"""The traces of docs/how-to/bring-up-a-pico.md are those of the present image."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs" / "pictures"


@pytest.mark.slow
def test_the_pictures_are_those_of_the_image(tmp_path):
    subprocess.run([sys.executable, ROOT / "scripts" / "scope_traces.py", tmp_path], check=True)
    drawn = {path.name: path.read_text() for path in tmp_path.glob("*.svg")}
    assert drawn == {path.name: path.read_text() for path in PICTURES.glob("pico-*.svg")}, "run scripts/scope-traces"


def test_the_page_shows_all_of_them():
    page = (ROOT / "docs" / "how-to" / "bring-up-a-pico.md").read_text()
    assert all(f"pictures/{path.name}" in page for path in PICTURES.glob("pico-*.svg"))
