"""`scripts/load` for a few seconds: it runs and prints its statistics, which depend on the computer."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_short_load_prints_its_statistics():
    command = [sys.executable, ROOT / "scripts" / "load.py", "--minutes", "0.15", "--clients", "6", "--watchers", "3"]
    finished = subprocess.run(command, text=True, capture_output=True)
    output = finished.stdout
    for name in (
        "push",
        "dry run",
        "state",
        "answers",
        "STOP",
        "gate off",
        "memory",
        "underruns",
        "engine",
        "computer",
    ):
        assert re.search(rf"^{name}\b", output, re.MULTILINE), output + finished.stderr
    statuses = set(re.findall(r"'(\d+)': \d+", output))
    assert "200" in statuses
    assert statuses <= {"200", "201", "409"}  # 409: pushed while the board is not armed, after a stop
    underran = int(re.search(r"underruns +(\d+)", output)[1])
    assert (finished.returncode == 1) == (underran > 0 or "memory grew" in finished.stderr), finished.stderr
