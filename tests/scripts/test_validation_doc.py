"""The scripts reproduce the shipped files byte for byte."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def made(script, out):
    command = [sys.executable, ROOT / "scripts" / script, "--out", out]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_calibrated_set_is_what_the_fit_gives(tmp_path):
    printed = made("calibrate_parameters.py", tmp_path / "calibrated.toml")
    assert (tmp_path / "calibrated.toml").read_text() == (ROOT / "configs/parameters/calibrated.toml").read_text()
    for parameter in ("kappa", "tau_g", "phi"):
        assert f"\n{parameter}" in "\n" + printed


@pytest.mark.slow
def test_the_validation_pages_are_current(tmp_path):
    made("validation_doc.py", tmp_path)
    for page in ("explanation/validation.md", "reference/paper-facts.md"):
        if (tmp_path / page).read_text(encoding="utf-8") != (ROOT / "docs" / page).read_text(encoding="utf-8"):
            pytest.fail(f"docs/{page} is not current: run scripts/validation-doc")


def test_every_row_of_the_page_has_the_columns_of_its_heading():
    columns = None
    for line in (ROOT / "docs" / "explanation" / "validation.md").read_text(encoding="utf-8").splitlines():
        if not line.startswith("| "):
            columns = None
            continue
        columns = columns or line.count(" |")
        assert line.count(" |") == columns, line
