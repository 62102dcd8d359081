"""`scripts/bench gate`: two cheap measurements give well-formed rows on any computer."""

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "scripts" / "bench.py"
NUMBERS = ("median", "p99", "max", "late_p99_ms", "late_max_ms")


def run(*arguments):
    return subprocess.run([sys.executable, SCRIPT, "gate", *arguments], capture_output=True, text=True)


def test_rows_are_printed_as_JSON_and_judge_nothing():
    done = run("--only", "board", "--only", "parsing", "--json")
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [row["name"] for row in rows] == ["board", "parsing", "parsing"], done.stderr
    for row in rows:
        assert row["unit"] == "ms"
        assert row["n"] > 0, row
        assert all(isinstance(row[key], float) for key in NUMBERS), row
        assert row["misses_aim"] == (row["p99"] > row["aim"])


def test_an_unknown_measurement_is_refused_by_name():
    done = run("--only", "speed")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.splitlines()[-1].startswith(
        "scripts/bench gate: error: argument --only: invalid choice: 'speed'"
    )
