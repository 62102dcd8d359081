"""`optodrive docs`: pages and firmware of the package."""

import json
import tomllib
from pathlib import Path

import pytest

from optodrive.cli.docs import FOLDERS
from optodrive.cli.main import run

ROOT = Path(__file__).parents[3]


def test_all_pages_are_listed(capsys):
    assert run(["docs", "--json"]) == 0
    pages = json.loads(capsys.readouterr().out)["pages"]
    expected = [path.relative_to(ROOT).as_posix() for name in FOLDERS for path in (ROOT / name).rglob("*.md")]
    assert pages == sorted(expected)
    assert "docs/how-to/wire-a-board.md" in pages
    assert "firmware_protocol/PROTOCOL.md" in pages


@pytest.mark.parametrize("name", ["wire-a-board", "how-to/wire-a-board.md", "docs/how-to/wire-a-board"])
def test_a_page_is_printed(capsys, name):
    assert run(["docs", name]) == 0
    assert capsys.readouterr().out == (ROOT / "docs/how-to/wire-a-board.md").read_text()


def test_an_unknown_page_is_refused_with_the_nearest(capsys):
    assert run(["docs", "wire-a-bord"]) == 2
    assert "expected a page that `optodrive docs` lists, nearest is 'wire-a-board'\n" in capsys.readouterr().err
    assert run(["docs", "nope"]) == 2  # no page is near, and all of them would fill the terminal
    assert capsys.readouterr().err.endswith("expected a page that `optodrive docs` lists\n")


def test_a_copy_has_the_wiring_and_the_sources_of_the_firmware(tmp_path, capsys):
    out = tmp_path / "copy"
    assert run(["docs", "--out", str(out)]) == 0
    for name in (
        "docs/how-to/wire-a-board.md",
        "firmware_protocol/ports/rp2040/main.c",
        "firmware_protocol/PROTOCOL.md",
    ):
        assert (out / name).read_bytes() == (ROOT / name).read_bytes()
    capsys.readouterr()
    assert run(["docs", "--out", str(out)]) == 2
    assert "a new or empty folder" in capsys.readouterr().err


def test_the_wheel_is_declared_to_contain_them():
    """State the required contents where no build backend is at hand. tests/system/test_wheel.py builds the wheel."""
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    for name in FOLDERS:
        assert build["force-include"][name] == f"optodrive/_shipped/{name}"
