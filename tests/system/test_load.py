"""`scripts/load`, a few seconds of it: it runs, and says what it is asked for. Its figures are the computer's."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_short_load_is_answered_and_told():
    command = [sys.executable, ROOT / "scripts" / "load.py", "--minutes", "0.15", "--clients", "6", "--watchers", "3"]
    finished = subprocess.run(command, text=True, capture_output=True, timeout=110)
    told = finished.stdout
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
        assert re.search(rf"^{name}\b", told, re.MULTILINE), told + finished.stderr
    statuses = set(re.findall(r"'(\d+)': \d+", told))
    assert {"200", "201"} <= statuses <= {"200", "201", "409"}  # 409: pushed while nothing is armed, after a stop
    underran = int(re.search(r"underruns +(\d+)", told)[1])
    assert (finished.returncode == 1) == (underran > 0 or "memory grew" in finished.stderr), finished.stderr
