"""The gate fails if and only if one of its halves does, and shows what both said."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

HALVES = """
import sys

sys.path.insert(0, "scripts")
from gate import run_halves

sys.exit(run_halves(["sh", "-c", sys.argv[1]], ["sh", "-c", sys.argv[2]]))
"""


@pytest.mark.parametrize(("live", "computing", "code"), [(0, 0, 0), (3, 0, 3), (0, 4, 4), (3, 4, 3)])
def test_the_gate_ends_with_the_code_of_a_half_that_failed(live: int, computing: int, code: int) -> None:
    run = subprocess.run(
        [
            sys.executable,
            "-c",
            HALVES,
            f"echo live; exit {live}",
            f"sleep 0.1; echo computing; exit {computing}",
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (run.returncode, run.stdout.split()) == (code, ["live", "computing"]), run.stderr
